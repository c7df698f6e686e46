"""What follows from fleet.toml, the same in every vehicle."""

import json
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from hashlib import blake2s
from math import ceil, inf, radians, sqrt
from pathlib import Path
from typing import Any, Final, Literal

from companion.config.bounds import SPACING_MARGIN_M, FleetBounds
from companion.config.endpoints import companion_port
from companion.config.law_tables import LAWS
from companion.config.numbers import Table
from companion.config.registry import Origin
from companion.config.schema import GotoLegTable, HoldLegTable, LegTable, TurnLegTable, VelocityLegTable
from companion.config.trigger_tables import TRIGGERS
from companion.core import assignment
from companion.core.formation import SHAPES, Slots, centred, minimum_distance, rotated, shape_slots
from companion.core.frames import Geodetic, Ned
from companion.core.neighbours.graph import NeighbourKind
from companion.core.neighbours.sample import PeerLimits
from companion.core.safety.filter import DOWNWASH_RATIO
from companion.core.trajectory.fleet import PADS, FleetTrajectory, top_speed_m_s
from companion.core.trajectory.goto import goto_leg
from companion.core.trajectory.legs import FreeLeg, Leg, TurnLeg, VelocityLeg, leg_end
from companion.core.trajectory.slots import SlotChange
from companion.core.trajectory.successors import with_formation, with_return
from companion.core.trajectory_check import ALTITUDE_MIN_M, PLAN_SPEED_SHARE
from companion.core.values import ZERO
from companion.errors import ConfigError

LANDED_APART_M = 1.0
"""vehicles that land where they are come down so far apart: a collision's distance, and the wander of both"""
STALE_AFTER = 2.1
"""a peer is stale after this many T_max without a word: one message may be lost"""
PROCESS_END_S = 1.5
"""on a laptop processes end and no computer does: that is told within so long"""
DIGEST_LETTERS: Final = 4
NEAREST_ABOVE = 20
"""a larger fleet without a plan heeds the nearest, unless told otherwise"""


class Vehicle(Table):
    """One vehicle with every default resolved."""

    id: int
    instance: int
    """`launch.first_instance` and the position in the file: ports follow it"""
    system_id: int
    mavlink: str
    zenoh: str | None
    slot: int | Literal["auto"]
    pad_north_m: float
    pad_east_m: float
    signing_key: str | None = None

    def signing_key_beside(self, file: Path) -> Path | None:
        """The file of its link's key: named by the configuration, in whose folder it lies unless its path is whole."""
        return None if self.signing_key is None else file.parent / self.signing_key


class FleetConfig(FleetBounds):
    """fleet.toml and what follows from it: pads, slots, the first motion, gains and safety radius.

    All of it comes from the file alone, since the vehicles must agree on it exactly.
    """

    @cached_property
    def vehicles(self) -> tuple[Vehicle, ...]:
        """The enabled vehicles, in the file's order."""
        pads, first = self._grid_pads(), self.launch.first_instance
        return tuple(
            Vehicle(
                id=v.id,
                instance=first + k,
                system_id=v.id + first if v.system_id is None else v.system_id,
                mavlink=v.mavlink or f"udp://127.0.0.1:{companion_port(first + k)}",
                zenoh=v.zenoh,
                slot=v.slot,
                pad_north_m=pads[k].north if v.pad_m is None else v.pad_m[0],
                pad_east_m=pads[k].east if v.pad_m is None else v.pad_m[1],
                signing_key=v.signing_key,
            )
            for k, v in enumerate(self.vehicle)
            if v.enabled
        )

    def _grid_pads(self) -> Slots:
        """Two wide rows behind each other, as one lays vehicles out on a field."""
        n = len(self.vehicle)
        across = max(ceil(sqrt(2.5 * n)), 1)
        s = self.launch.spacing_m
        cells = [(-s * (k // across), s * (k % across), 0.0) for k in range(n)]
        return rotated(centred(cells), radians(self.launch.heading_deg))

    def by_id(self, vehicle_id: int) -> Vehicle:
        """The enabled vehicle of that id; refused if there is none."""
        for vehicle in self.vehicles:
            if vehicle.id == vehicle_id:
                return vehicle
        known = ", ".join(str(v.id) for v in self.vehicles)
        raise ConfigError(f"vehicle {vehicle_id} is not an enabled vehicle of this fleet; there are {known}")

    @property
    def origin(self) -> Geodetic:
        """Origin of the fleet frame; of no meaning in the local frame."""
        o = self.fleet.origin
        return Geodetic(0.0, 0.0, 0.0) if o is None else Geodetic(o.latitude_deg, o.longitude_deg, o.altitude_amsl_m)

    @property
    def foreign(self) -> tuple[Origin, ...]:
        """Where the kinds of law and trigger come from that are not ours."""
        origins = (LAWS.origin(self.law.kind), TRIGGERS.origin(self.trigger.kind))
        return tuple(o for o in origins if o is not None)

    def motion_into(self, shape: str, motion: FleetTrajectory, at_ns: int, issuer: int) -> FleetTrajectory:
        """The motion that takes over from `motion` with another formation.

        The slots use what speed the centre leaves them, half of the limit at most.
        """
        x = self.limits
        left = x.speed_max_m_s - top_speed_m_s(motion)
        return with_formation(
            motion, at_ns=at_ns, issuer=issuer, shape=shape, slots=self.slots(shape), pinned=self.pinned,
            speed_m_s=max(min(left, x.speed_max_m_s / 2), (1.0 - PLAN_SPEED_SHARE) * x.speed_max_m_s),
            climb_m_s=x.climb_max_m_s / 4, descent_m_s=x.descent_max_m_s / 4,
        )  # fmt: skip

    def motion_home(self, motion: FleetTrajectory, at_ns: int, issuer: int) -> FleetTrajectory:
        """The motion that takes over from `motion` and brings every vehicle back over its own pad, to land."""
        share = PLAN_SPEED_SHARE / 2
        return with_return(
            motion, self.first_motion, at_ns=at_ns, issuer=issuer, speed_m_s=self.return_speed_m_s,
            climb_m_s=share * self.limits.climb_max_m_s, descent_m_s=share * self.limits.descent_max_m_s,
        )  # fmt: skip

    @property
    def neighbours(self) -> NeighbourKind:
        """Whom the law heeds."""
        if self.peers.neighbours != "auto":
            return self.peers.neighbours
        return "nearest" if self.plan.kind == "none" and len(self.vehicles) > NEAREST_ABOVE else "range"

    @property
    def peer_limits(self) -> PeerLimits:
        return PeerLimits(
            hold=self.law.holding(),
            range_m=self.peers.range_m,
            stale_after_s=STALE_AFTER * self.trigger.t_max_s,
            heartbeat_s=self.trigger.t_max_s,
            isolated_flight_s=self.peers.isolated_flight_s,
            notice_lost_s=self.notice_lost_s if self.peers.network == "field" else PROCESS_END_S,
            notice_spread_s=self.keep_alive_s if self.peers.network == "field" else 0.0,
            uncertainty_m=self.prediction_error_m,
            motion=self.peer_motion,
            digest_size=self.peers.digest,
            neighbours=self.neighbours,
            nearest=self.peers.nearest,
        )

    def slots(self, shape: str) -> Slots:
        """Slots (forward, right, down) of a shape for the enabled vehicles; refused if they are too close."""
        count = len(self.vehicles)
        if shape == "custom":
            if len(self.formation.custom_m) != count:
                raise ConfigError(
                    f"$.formation.custom_m must have one slot for each of the {count} enabled vehicles, "
                    f"got {len(self.formation.custom_m)}"
                )
            slots = centred(self.formation.custom_m)
        elif shape in SHAPES:
            slots = shape_slots(shape, count, self.formation.spacing_m)
        else:
            raise ConfigError(f"$.formation.shape must be one of {', '.join((*SHAPES, 'custom'))}, got {shape!r}")
        self._check_slots(shape, slots)
        lowest = self.formation.altitude_m - max(s.down for s in slots)
        if lowest < ALTITUDE_MIN_M:
            raise ConfigError(
                f"$.formation.altitude_m: {shape!r} must have no slot below {ALTITUDE_MIN_M:g} m, got {lowest:.2f}"
            )
        return slots

    def _check_slots(self, shape: str, slots: Slots) -> None:
        nearest = minimum_distance(slots)
        if nearest < self.spacing_min_m:
            raise ConfigError(
                f"$.formation.spacing_m: {shape!r} needs at least {self.spacing_min_m:.2f} m "
                f"(the larger of separation's range {self.r0_m:.2f} m and the safety radius "
                f"{self.safety_radius_m:.2f} m, {self.radius_reason}, and {SPACING_MARGIN_M} m), got {nearest:.2f} m"
            )
        if minimum_distance(slots, DOWNWASH_RATIO) < self.safety_radius_m + SPACING_MARGIN_M and self.limits.barrier:
            raise ConfigError(
                f"$.formation.spacing_m: slots of {shape!r} lie above each other inside the downwash ellipsoid "
                f"(vertical half-axis {DOWNWASH_RATIO * self.safety_radius_m:.2f} m, horizontal "
                f"{self.safety_radius_m:.2f} m): choose a larger spacing or a level shape"
            )
        level = minimum_distance([Ned(s.north, s.east, 0.0) for s in slots])
        if level < LANDED_APART_M * (1.0 - 1e-9):
            raise ConfigError(
                f"$.formation.spacing_m: slots of {shape!r} must be at least {LANDED_APART_M:g} m apart on the level, "
                f"since vehicles land where they are, got {level:.2f} m: choose a larger spacing or a level shape"
            )

    @cached_property
    def pinned(self) -> dict[int, int]:
        """Vehicle id -> slot, for the vehicles whose slot the file fixes."""
        return {v.id: v.slot for v in self.vehicles if v.slot != "auto"}

    @cached_property
    def first_motion(self) -> FleetTrajectory:
        """Where everybody starts: each over its own pad at the formation's altitude, at rest."""
        heading = radians(self.formation.heading_deg)
        pads = [Ned(v.pad_north_m, v.pad_east_m, 0.0) for v in self.vehicles]
        centre = [sum(p[k] for p in pads) / len(pads) for k in range(2)]
        level = rotated(centred(pads), -heading)
        return FleetTrajectory(
            revision=0,
            start_ns=0,
            issuer=0,
            shape=PADS,
            slots={v.id: SlotChange(s, s) for v, s in zip(self.vehicles, level, strict=True)},
            blend_start_ns=0,
            blend_s=0.0,
            legs_start_ns=0,
            centre_ned_m=Ned(centre[0], centre[1], -self.formation.altitude_m),
            velocity_ned_m_s=ZERO,
            heading_rad=heading,
            heading_rate_rad_s=0.0,
            heading_follows_turns=self.plan.heading == "track",
            legs=(),
        )

    def plan_legs(self, start: Ned, velocity: Ned = ZERO) -> tuple[Leg, ...]:
        """The plan's legs, begun at `start` with `velocity` (the centre's, m and m/s)."""
        return tuple(self._legs(self.plan.legs, start, velocity))

    def shared_legs(self, start: Ned, velocity: Ned = ZERO) -> tuple[Leg, ...]:
        """Those that all fly: the plan's, or without one the leg in which no motion is shared."""
        return (FreeLeg(),) if self.plan.kind == "none" else self.plan_legs(start, velocity)

    def waypoint(self, start: Ned, velocity: Ned, table: GotoLegTable) -> Leg:
        """The leg to a waypoint from a place and a velocity of the centre, within the vertical limits."""
        x = self.limits
        down = start.down if table.altitude_m is None else -table.altitude_m
        return goto_leg(
            start, velocity, Ned(table.north_m, table.east_m, down), table.speed_m_s,
            PLAN_SPEED_SHARE * x.climb_max_m_s, PLAN_SPEED_SHARE * x.descent_max_m_s,
        )  # fmt: skip

    def _legs(self, tables: Sequence[LegTable], place: Ned, velocity: Ned) -> Iterator[Leg]:
        """Legs of the core from their tables; how long a waypoint takes follows from where the leg before has led."""
        for table in tables:
            leg: Leg
            match table:
                case HoldLegTable():
                    leg = VelocityLeg(ZERO, table.duration_s)
                case VelocityLegTable():
                    leg = VelocityLeg(Ned(table.north_m_s, table.east_m_s, -table.up_m_s), table.duration_s)
                case TurnLegTable():
                    angle = inf if table.angle_deg is None else radians(table.angle_deg)
                    leg = TurnLeg(radians(table.rate_deg_s), angle)
                case GotoLegTable():
                    leg = self.waypoint(place, velocity, table)
            yield leg
            _, place, velocity, _ = leg_end(leg, place, velocity)

    @cached_property
    def first_formation(self) -> FleetTrajectory:
        """The change of formation that the vehicles begin with: from their pads to the slots as all assign them."""
        return self.motion_into(self.formation.shape, self.first_motion, self.first_motion.start_ns, 0)

    @cached_property
    def assignment_hash(self) -> str:
        """Digest of who takes which slot of the first formation, to a millimetre, and of the rule that says so."""
        slots = self.first_formation.slots
        text = "".join(f"{i}:{','.join(f'{x + 0.0:.3f}' for x in slots[i].after)};" for i in sorted(slots))
        text = f"{assignment.VERSION}|{text}"
        return blake2s(text.replace("-0.000", "0.000").encode(), digest_size=8).hexdigest()

    @cached_property
    def shared_hash(self) -> str:
        """Digest of what the vehicles must agree on: everything but links and the stubs' noise, the packages of
        foreign kinds included."""
        return blake2s(json.dumps(self._shared, sort_keys=True).encode(), digest_size=8).hexdigest()

    @cached_property
    def _shared(self) -> dict[str, Any]:
        shared = self.model_dump(exclude={"stub": True, "vehicle": {"__all__": {"mavlink", "zenoh"}}})
        return {**shared, "foreign": self.foreign} if self.foreign else shared

    @cached_property
    def shared_digests(self) -> dict[str, str]:
        """Of each table that the vehicles must agree on: so many letters for each of its keys, in their order."""
        return {table: "".join(_digest(x) for _, x in _rows(value)) for table, value in self._shared.items()}

    def differing(self, digests: Mapping[str, str]) -> list[str]:
        """The keys of which somebody else's digests tell another value; of a table of another length its name."""
        found = []
        for table, own in self.shared_digests.items():
            other = digests.get(table, "")
            if len(own) != len(other):
                found.append(table)
                continue
            for k, (key, _) in enumerate(_rows(self._shared[table])):
                place = slice(k * DIGEST_LETTERS, (k + 1) * DIGEST_LETTERS)
                if own[place] != other[place]:
                    found.append(f"{table}{key}")
        return [*found, *(table for table in digests if table not in self.shared_digests)]


def _rows(value: Any) -> list[tuple[str, Any]]:
    """The values of a table or a list, each with its key as it is written after the table's name."""
    if isinstance(value, dict):
        return [(f".{key}", value[key]) for key in sorted(value)]
    return [(f"[{k}]", x) for k, x in enumerate(value)] if isinstance(value, list | tuple) else [("", value)]


def _digest(value: Any) -> str:
    return blake2s(json.dumps(value, sort_keys=True).encode(), digest_size=DIGEST_LETTERS // 2).hexdigest()
