"""The operator's side of a fleet: questions and commands to every vehicle, each acknowledged or named as silent.

The operator is no leader: a command is a new motion (or a verb), the same bytes to every vehicle, and each vehicle
decides for itself whether it takes it. A command says at which place (`orders`) it finds each vehicle.

What one vehicle answers is its own: an answer that cannot be read, or a plan that nobody could follow, leaves that
vehicle out, by name. Two companions that answer as one vehicle are two fleets, or one too many: they are refused.
"""

import json
import secrets
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from math import isfinite, pi, radians
from typing import Any, Protocol

from pydantic import ValidationError

from companion.config import FleetConfig
from companion.config.schema import GotoLegTable
from companion.core.frames import Ned
from companion.core.route import only_stops
from companion.core.trajectory.fleet import FleetTrajectory
from companion.core.trajectory.legs import Leg, TurnLeg, VelocityLeg
from companion.core.trajectory.successors import with_legs
from companion.core.trajectory_check import examine
from companion.core.values import ZERO
from companion.errors import RefusedError, WireError
from companion.operator.preflight import Report, best_offset, fleet_report
from companion.operator.status import read_status
from companion.vehicle.orders import ENDING, REVISION_JUMP_MAX, Place, read_place
from companion.vehicle.preflight import ClockReading, PreflightReport
from companion.wire.peer import decode_motion, encode_motion

COMMAND_LEAD_NS = 2_000_000_000
"""how far ahead of now a commanded motion starts, so that every vehicle has it by then"""
ANSWER_TIMEOUT_S = 5.0
ENDING_TIMEOUTS_S = (1.0, 1.0, 2.0, 1.0)
"""what ends a flight is commanded anew after these, to whoever is silent or has begun another flight meanwhile"""
MOTION_AHEAD_NS = 3_600_000_000_000
"""a motion that begins later than this is nobody's: no vehicle takes one"""
REVISIONS = 1 << 32
"""of motions, on the wire"""
STATUS_TIMEOUT_S = 1.0
KILL_STATUS_TIMEOUT_S = 0.6
RETRY_S = 0.5
LOOK_AGAIN_S = 0.5
"""a vehicle that hears its own id from elsewhere and answers alone is asked again after so long, as often as that fits
into the time for an answer: a liar delays a kill by no more"""
REASON_LENGTH_MAX = 500
UP_TOGETHER_S = 30.0
"""companions that began within this are told as one start"""
PREFLIGHT_TIMEOUT_S = 3.0
CLOCK_ROUNDS_LEAST, CLOCK_ROUNDS_MOST = 3, 10
CLOCK_SURE_SHARE = 0.25
"""clocks are asked again until each is known to this share of their limit, or the rounds are over"""


class Link(Protocol):
    """How questions reach the vehicles (`io.transport.OperatorLink`)."""

    def ask(
        self, vehicle_ids: Iterable[int], kind: str, payload: bytes, timeout_s: float, retry_s: float
    ) -> dict[int, tuple[bytes, ...]]:
        """Answers by vehicle id: none from the silent, more than one where several companions answer under one id."""

    def ask_timed(
        self, vehicle_ids: Iterable[int], kind: str, payload: bytes, timeout_s: float, retry_s: float
    ) -> dict[int, tuple[bytes, int, int] | None]:
        """Each one's first answer, with when it was asked and when it answered (UTC, ns)."""

    def wait(self, seconds: float) -> None:
        """Let time pass, in which the link may find more companions."""


class PreflightError(RefusedError):
    """The fleet is not fit to take off; `report` says why."""

    def __init__(self, report: Report) -> None:
        super().__init__("not fit for take-off:\n" + "\n".join(f"  {fault}" for fault in report.faults))
        self.report = report


@dataclass(frozen=True, slots=True)
class Answers:
    """What the vehicles said to a command."""

    accepted: tuple[int, ...]
    refused: Mapping[int, str]
    """vehicle id -> its reason"""
    silent: tuple[int, ...]
    outdated: tuple[int, ...] = ()
    """who refused since it has gone on: another place in the order of commands, a newer motion"""
    notes: tuple[str, ...] = ()
    """who was left out, and why"""

    @property
    def all_accepted(self) -> bool:
        """Whether every vehicle took it."""
        return not self.refused and not self.silent

    def sentence(self, verb: str) -> str:
        """For people: who took it, who refused and why, who is silent."""
        parts = [f"{verb}: accepted by {len(self.accepted)}"]
        parts += [f"vehicle {i} refused: {reason}" for i, reason in sorted(self.refused.items())]
        if self.silent:
            parts.append(f"silent: vehicle {', '.join(str(i) for i in self.silent)}")
        parts += self.notes
        return "; ".join(parts)


class Operator:
    """Commands to a running fleet."""

    def __init__(self, config: FleetConfig, link: Link, issuer: str | None = None, *, both: bool = False) -> None:
        self.config = config
        self.link = link
        self.ids = tuple(v.id for v in config.vehicles)
        self.issuer = f"operator-{secrets.token_hex(4)}" if issuer is None else issuer
        self.both = both
        """whether what ends a flight goes to both of two companions that answer as one vehicle"""
        self.unreadable: dict[int, str] = {}
        """vehicle id -> what is wrong with its last status"""
        self.doubled: dict[int, str] = {}
        """vehicle id -> which companions answer as this one vehicle"""
        self._places: dict[int, dict[int, Place]] = {}
        """vehicle id -> boot id -> where that companion last said to be"""
        self._unfollowed: dict[int, str] = {}
        """vehicle id -> what is wrong with the plan that it told last"""
        self._seen: dict[int, tuple[str, float]] = {}
        """vehicle id -> its fleet's name, and since when its companion runs (s)"""

    def status(self, timeout_s: float = STATUS_TIMEOUT_S) -> dict[int, dict[str, Any] | None]:
        """Each vehicle's own account of itself; None from the silent, and from the unreadable, who are named there."""
        answers = dict(self.link.ask(self.ids, "status", b"", timeout_s, RETRY_S))
        for _ in range(round(timeout_s / LOOK_AGAIN_S)):
            # That somebody spoke under an id is no second companion, but may be one that the link has not found yet.
            single = [i for i, told in answers.items() if len(told) == 1 and _hears_own_id(told[0], i)]
            if not single:
                break
            self.link.wait(LOOK_AGAIN_S)
            answers |= self.link.ask(single, "status", b"", timeout_s, RETRY_S)
        return {i: self._status(i, answers.get(i, ())) for i in self.ids}

    def _status(self, i: int, answers: tuple[bytes, ...]) -> dict[str, Any] | None:
        readable: list[dict[str, Any]] = []
        faults: list[str] = []
        for answer in answers:
            said = read_status(answer, i)
            if isinstance(said, str):
                faults.append(said)
            else:
                readable.append(said)
        self.unreadable.pop(i, None)
        if faults:
            self.unreadable[i] = faults[0]
        if answers:
            self._places[i] = {}
            self._note_places(i, readable)
            self.doubled.pop(i, None)
        runs = [f"one up for {s['up_s']:.0f} s" for s in readable] + ["one that cannot be read"] * len(faults)
        if len(runs) > 1:
            self.doubled[i] = " and ".join(runs)
        if not readable:
            return None
        self._seen[i] = readable[0]["fleet"], readable[0]["up_s"]
        return readable[0]

    def _note_places(self, i: int, said: Iterable[Mapping[str, Any]]) -> None:
        for s in said:
            if (place := read_place(s.get("place"))) is not None:
                self._places.setdefault(i, {})[place.boot_id] = place

    @property
    def left_out(self) -> tuple[str, ...]:
        """Whoever answers what cannot be read, as sentences."""
        return tuple(f"vehicle {i}'s status cannot be read: {why}" for i, why in sorted(self.unreadable.items()))

    @property
    def two_companions(self) -> tuple[str, ...]:
        """Which vehicles are more than one companion, as sentences."""
        return tuple(f"vehicle {i} is two companions, {runs}" for i, runs in sorted(self.doubled.items()))

    @property
    def reached(self) -> str:
        """Which flight the last status was of."""
        if not self._seen:
            return f"fleet {self.config.fleet.name}: nobody"
        names = sorted({name for name, _ in self._seen.values()})
        shortest, longest = (f(up for _, up in self._seen.values()) for f in (min, max))
        since = f"{longest:.0f} s" if longest - shortest < UP_TOGETHER_S else f"{shortest:.0f} to {longest:.0f} s"
        return f"fleet {' and '.join(names)}, companions up for {since}"

    def command(self, verb: str, vehicle: int | None = None, **more: object) -> Answers:
        """A verb to every vehicle or to one, asked again until each has answered or the time is over.

        What ends a flight is commanded anew to whoever has begun another flight meanwhile, and to the silent, for whom
        nobody else waits; anything else to those alone whose place was not known.
        """
        ids = self.ids if vehicle is None else (self.config.by_id(vehicle).id,)
        self._refuse_doubles(ids, verb)
        ending = verb in ENDING
        unknown = frozenset(i for i in ids if not self._places.get(i))
        accepted: list[int] = []
        refused: dict[int, str] = {}
        for timeout_s in ENDING_TIMEOUTS_S if ending else (ANSWER_TIMEOUT_S, ANSWER_TIMEOUT_S):
            last = self._ask(ids, verb, timeout_s, more)
            accepted += last.accepted
            refused |= last.refused
            again = (*last.outdated, *last.silent) if ending else tuple(i for i in last.outdated if i in unknown)
            if not again:
                break
            ids, unknown = again, frozenset()
        refused = {i: reason for i, reason in refused.items() if i not in (*accepted, *last.silent)}
        return Answers(tuple(sorted(accepted)), refused, last.silent, last.outdated)

    def _refuse_doubles(self, ids: Iterable[int], verb: str) -> None:
        if self.doubled.keys().isdisjoint(ids) or (self.both and verb in ENDING):
            return
        name = self.config.fleet.name
        raise RefusedError(
            f"{'; '.join(self.two_companions)}: does another fleet of the name {name!r} fly here? Nobody was "
            "commanded; end one of them (land, release and kill take --both)"
        )

    def _ask(self, ids: Iterable[int], verb: str, timeout_s: float, more: Mapping[str, object]) -> Answers:
        """One command, the same bytes to each."""
        ids = tuple(ids)
        after = {i: list(self._places.get(i, {}).values()) for i in ids}
        order = {"verb": verb, "id": secrets.token_hex(8), "issuer": self.issuer, "after": after, **more}
        accepted, refused, silent, outdated = [], {}, [], []
        for i, answers in self.link.ask(ids, "command", json.dumps(order).encode(), timeout_s, RETRY_S).items():
            said = [s for s in map(_object, answers) if s is not None]
            if not said:
                silent.append(i)
                continue
            self._note_places(i, said)
            reasons = [str(s.get("reason"))[:REASON_LENGTH_MAX] for s in said if s.get("accepted") is not True]
            if not reasons:
                accepted.append(i)
                continue
            refused[i] = "; ".join(reasons)
            if len(said) > 1:
                refused[i] = f"two companions answer as this vehicle: {refused[i]}"
            if any(_outdated(order, s) for s in said):
                outdated.append(i)
        return Answers(tuple(accepted), refused, tuple(silent), tuple(outdated))

    def take_off(self) -> Answers:
        """Every vehicle arms and climbs; PreflightError if the fleet is not fit, and then nobody is asked to."""
        report = self.preflight()
        if not report.fit:
            raise PreflightError(report)
        self.status()
        return self.command("takeoff")

    def preflight(self) -> Report:
        """Every vehicle's own checks, and what they say compared."""
        answers = self.link.ask(self.ids, "preflight", b"", PREFLIGHT_TIMEOUT_S, RETRY_S)
        read = {i: [_account(a) for a in all_of] for i, all_of in answers.items()}
        accounts = {i: next((a for a in some if isinstance(a, PreflightReport)), None) for i, some in read.items()}
        unreadable = {i: why for i, some in read.items() for why in some if isinstance(why, str)}
        boots = {
            i: {a.boot_id for a in some if isinstance(a, PreflightReport)} for i, some in read.items() if accounts[i]
        }
        readings: dict[int, list[tuple[int, int, int, int]]] = {i: [] for i in boots}
        sure_s = CLOCK_SURE_SHARE * self.config.preflight.clock_limit_s
        for k in range(CLOCK_ROUNDS_MOST if boots else 0):
            for i, answer in self.link.ask_timed(boots, "preflight", b"clock", STATUS_TIMEOUT_S, RETRY_S).items():
                if answer is not None and (reading := _clock_reading(answer[0])) is not None:
                    readings[i].append((answer[1], reading.received_ns, reading.answered_ns, answer[2]))
                    boots[i].add(reading.boot_id)
            known = [best_offset(r) for r in readings.values()]
            sure = all(o is not None and o.uncertain_s <= sure_s for o in known)
            if sure and k + 1 >= CLOCK_ROUNDS_LEAST:
                break
        offsets = {i: best_offset(r) for i, r in readings.items()}
        return fleet_report(self.config, accounts, offsets, {i: frozenset(b) for i, b in boots.items()}, unreadable)

    def land(self, vehicle: int | None = None) -> Answers:
        """Every vehicle, or one, lands where it is."""
        self.status()
        return self.command("land", vehicle)

    def release(self, vehicle: int | None = None) -> Answers:
        """Every vehicle, or one, is the pilot's: no setpoint any more, its autopilot in hold mode."""
        self.status()
        return self.command("release", vehicle)

    def resume(self, vehicle: int | None = None) -> Answers:
        """Companions steer again whoever was released, or was found in the air at their start."""
        self.status()
        return self.command("resume", vehicle)

    def kill(self, vehicle: int | None = None) -> Answers:
        """Motors stop at once, in the air too. Whoever calls this has asked a person whether it is meant."""
        self.status(KILL_STATUS_TIMEOUT_S)
        return self.command("kill", vehicle, confirm=True)

    def rtl(self, now_ns: int) -> Answers:
        """Back over the pads, each vehicle over its own, and land there; RefusedError before the fleet has formed."""
        newest = self._formed(now_ns)
        return self._send(self.config.motion_home(newest, self._start_ns(newest, now_ns), 0), newest)

    def form(self, shape: str, now_ns: int) -> Answers:
        """Another formation; RefusedError if nobody says where the fleet is, ConfigError for an unknown shape."""
        self.config.slots(shape)
        newest = self._formed(now_ns)
        # Slots that are still on their way to the last formation arrive there first.
        start_ns = max(self._start_ns(newest, now_ns), newest.blend_end_ns)
        return self._send(self.config.motion_into(shape, newest, start_ns, 0), newest)

    def move(self, leg: Leg, now_ns: int) -> Answers:
        """Another motion of the formation; RefusedError before it has formed by itself."""
        newest = self._formed(now_ns)
        motion = with_legs(newest, at_ns=self._start_ns(newest, now_ns), issuer=0, legs=(leg,))
        if abs(motion.climb_at_end_m_s) > 1e-6:
            raise RefusedError("the formation would climb or sink for ever: give it a place and an altitude to go to")
        return self._send(motion, newest)

    def goto(self, north_m: float, east_m: float, altitude_m: float | None, speed_m_s: float, now_ns: int) -> Answers:
        """Fly the formation's centre to a point of the fleet frame and stop there."""
        newest = self._formed(now_ns)
        start_ns = self._start_ns(newest, now_ns)
        here = newest.state_at(start_ns).centre
        try:
            waypoint = GotoLegTable(
                kind="goto", north_m=north_m, east_m=east_m, altitude_m=altitude_m, speed_m_s=speed_m_s
            )
        except ValidationError as error:
            first = error.errors()[0]
            raise RefusedError(f"goto: {first['loc'][0]}: {first['msg']}, got {first['input']!r}") from error
        leg = self.config.waypoint(here.position, here.velocity, waypoint)
        return self._send(with_legs(newest, at_ns=start_ns, issuer=0, legs=(leg,)), newest)

    def hold(self, clock_ns: Callable[[], int]) -> Answers:
        """Stop where the formation is; once more from what is newest then, if a vehicle has a newer motion or command.

        A motion that one vehicle refuses for a newer one is soon replaced by that in all others too.
        """
        answers = self.move(VelocityLeg(ZERO, 0.0), clock_ns())
        return self.move(VelocityLeg(ZERO, 0.0), clock_ns()) if answers.outdated else answers

    def _formed(self, now_ns: int) -> FleetTrajectory:
        newest = self._newest(now_ns)
        if newest.revision == 0 and self.config.plan.automatic:
            # A motion of ours would take the place of the one by which the vehicles form.
            raise RefusedError("the fleet is not in formation yet")
        return newest

    def _newest(self, now_ns: int) -> FleetTrajectory:
        """The newest motion that any vehicle tells; whoever tells one that nobody could follow is left out by name."""
        motions: dict[int, FleetTrajectory] = {}
        self._unfollowed = {}
        told = self.status()
        self._refuse_doubles(self.ids, "motion")
        for i, said in told.items():
            if said is not None:
                motion = _followable(said["motion"], now_ns)
                if isinstance(motion, str):
                    self._unfollowed[i] = motion
                else:
                    motions[i] = motion
        for i in _too_far_ahead({i: m.revision for i, m in motions.items()}):
            self._unfollowed[i] = f"its revision {motions.pop(i).revision} is far ahead of all others"
        if not motions:
            left_out = self._left_out()
            if left_out:
                raise RefusedError("; ".join(left_out))
            raise RefusedError("no vehicle answers; is the fleet up, and is this its fleet.toml?")
        newest = max(motions.values(), key=lambda m: m.order)
        if newest.revision + 1 >= REVISIONS:
            raise RefusedError("the revisions of motions are used up: land, and start the companions anew")
        return newest

    def _left_out(self) -> tuple[str, ...]:
        plans = (f"vehicle {i}'s plan cannot be followed: {why}" for i, why in sorted(self._unfollowed.items()))
        return (*self.left_out, *plans)

    def _start_ns(self, newest: FleetTrajectory, now_ns: int) -> int:
        return max(now_ns + COMMAND_LEAD_NS, newest.start_ns + 1)

    def _send(self, motion: FleetTrajectory, newest: FleetTrajectory) -> Answers:
        """Command a motion; RefusedError for one that every vehicle would refuse."""
        fault = examine(motion, self.config.motion_limits, newest).fault
        if fault is not None and not only_stops(motion, newest):
            raise RefusedError(fault.sentence)
        return replace(self.command("motion", motion=json.loads(encode_motion(motion))), notes=self._left_out())


def _hears_own_id(answer: bytes, vehicle_id: int) -> bool:
    said = read_status(answer, vehicle_id)
    return not isinstance(said, str) and bool(said.get("own_id_heard"))


def _followable(told: Mapping[str, Any], now_ns: int) -> FleetTrajectory | str:
    """A motion as a vehicle tells it, or why nobody could follow it."""
    try:
        motion = decode_motion(json.dumps(told).encode())
        if motion.start_ns > now_ns + MOTION_AHEAD_NS:
            return "it starts more than an hour from now"
        here = motion.state_at(max(now_ns, motion.start_ns)).centre
        if not all(isfinite(x) for x in (*here.position, *here.velocity)):
            return "it leads nowhere"
    except (WireError, ArithmeticError, ValueError, LookupError, RecursionError) as error:
        return str(error) or type(error).__name__
    return motion


def _too_far_ahead(revisions: Mapping[int, int]) -> Iterator[int]:
    """Vehicles whose motion's revision the others would refuse; who starts late holds 0 and is no measure."""
    known = sorted(r for r in revisions.values() if r > 0) or [0]
    middle = known[(len(known) - 1) // 2]
    return (i for i, r in revisions.items() if r > middle + REVISION_JUMP_MAX)


def _account(answer: bytes) -> PreflightReport | str:
    """A vehicle's account, or what is wrong with it."""
    try:
        return PreflightReport.model_validate_json(answer)
    except ValidationError as error:
        first = error.errors()[0]
        return f"{'.'.join(str(p) for p in first['loc']) or 'JSON'}: {first['msg']}"[:200]


def _clock_reading(answer: bytes) -> ClockReading | None:
    try:
        return ClockReading.model_validate_json(answer)
    except ValidationError:
        return None


def _object(answer: bytes) -> dict[str, Any] | None:
    """An answer's JSON object; None from whoever answers anything else."""
    try:
        said = json.loads(answer)
    except (ValueError, RecursionError):
        return None
    return said if isinstance(said, dict) else None


def _outdated(order: Mapping[str, Any], said: Mapping[str, Any]) -> bool:
    """Whether a vehicle that refused has gone on since: by a command, or to a motion as new as this one."""
    if said.get("in_order") is False:
        return True
    held = said.get("revision")
    return order["verb"] == "motion" and isinstance(held, int) and held >= order["motion"]["revision"]


def velocity_leg(north_m_s: float, east_m_s: float, up_m_s: float) -> VelocityLeg:
    """Constant velocity until told otherwise."""
    return VelocityLeg(Ned(north_m_s, east_m_s, -up_m_s), 0.0)


def turn_leg(rate_deg_s: float, angle_deg: float | None) -> TurnLeg:
    """A turn through an angle, or circling (None)."""
    return TurnLeg(radians(rate_deg_s), float("inf") if angle_deg is None else angle_deg * pi / 180.0)
