"""The operator's side of a fleet: questions and commands to every vehicle, each acknowledged or named as silent.

The operator is no leader: a command is a new motion (or a verb), the same bytes to every vehicle, and each vehicle
decides for itself whether it takes it.
"""

import json
import secrets
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from math import pi, radians
from typing import Any, Protocol

from pydantic import ValidationError

from companion.config import FleetConfig, GotoLegTable
from companion.core.frames import Ned
from companion.core.motion_check import examine
from companion.core.plan import Leg, Motion, TurnLeg, VelocityLeg, with_legs
from companion.core.route import only_stops
from companion.core.values import ZERO
from companion.errors import RefusedError, WireError
from companion.preflight import Account, ClockReading
from companion.preflight_fleet import Report, best_offset, fleet_report
from companion.wire.peer import decode_motion, encode_motion

COMMAND_LEAD_NS = 2_000_000_000
"""how far ahead of now a commanded motion starts, so that every vehicle has it by then"""
ANSWER_TIMEOUT_S = 5.0
INSISTED = frozenset({"land", "release", "kill"})
"""verbs that no number may keep from a vehicle: commanded again above whatever it has obeyed"""
INSISTED_TIMEOUTS_S = (1.0, 1.0, 2.0, 1.0)
STATUS_TIMEOUT_S = 1.0
KILL_STATUS_TIMEOUT_S = 0.6
RETRY_S = 0.5
PREFLIGHT_TIMEOUT_S = 3.0
CLOCK_ROUNDS_LEAST, CLOCK_ROUNDS_MOST = 3, 10
CLOCK_SURE_SHARE = 0.25
"""clocks are asked again until each is known to this share of their limit, or the rounds are over"""


class Link(Protocol):
    """How questions reach the vehicles (`io.zenoh_peers.OperatorLink`)."""

    def ask(
        self, vehicle_ids: Iterable[int], kind: str, payload: bytes, timeout_s: float, retry_s: float
    ) -> dict[int, bytes | None]:
        """Answers by vehicle id, None from the silent."""

    def ask_timed(
        self, vehicle_ids: Iterable[int], kind: str, payload: bytes, timeout_s: float, retry_s: float
    ) -> dict[int, tuple[bytes, int, int] | None]:
        """The same, with when each was asked and when it answered (UTC, ns)."""


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
    """who refused since it has a newer command or motion"""

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
        return "; ".join(parts)


class Operator:
    """Commands to a running fleet, each newer than what any vehicle has obeyed."""

    def __init__(self, config: FleetConfig, link: Link, issuer: str | None = None) -> None:
        self.config = config
        self.link = link
        self.ids = tuple(v.id for v in config.vehicles)
        self.issuer = f"operator-{secrets.token_hex(4)}" if issuer is None else issuer
        self._revision = 0
        """of the newest command that was seen or given"""

    def status(self, timeout_s: float = STATUS_TIMEOUT_S) -> dict[int, dict[str, Any] | None]:
        """Each vehicle's own account of itself; None from the silent."""
        told = {i: _object(a) for i, a in self.link.ask(self.ids, "status", b"", timeout_s, RETRY_S).items()}
        self._revision = max([self._revision, *(_command_rank(s)[0] for s in told.values() if s is not None)])
        return told

    def command(self, verb: str, vehicle: int | None = None, **more: object) -> Answers:
        """A verb to every vehicle or to one, asked again until each has answered or the time is over.

        Those in INSISTED are commanded again, as a newer command, to whoever has obeyed a newer one meanwhile, and to
        the silent, for whom nobody else waits.
        """
        ids = self.ids if vehicle is None else (self.config.by_id(vehicle).id,)
        if verb not in INSISTED:
            return self._ask(ids, verb, ANSWER_TIMEOUT_S, more)
        accepted: list[int] = []
        refused: dict[int, str] = {}
        for timeout_s in INSISTED_TIMEOUTS_S:
            last = self._ask(ids, verb, timeout_s, more)
            accepted += last.accepted
            refused |= last.refused
            ids = (*last.outdated, *last.silent)
            if not ids:
                break
        refused = {i: reason for i, reason in refused.items() if i not in (*accepted, *last.silent)}
        return Answers(tuple(sorted(accepted)), refused, last.silent, last.outdated)

    def _ask(self, ids: Iterable[int], verb: str, timeout_s: float, more: Mapping[str, object]) -> Answers:
        """The next command, the same bytes to each."""
        self._revision += 1
        order = {"verb": verb, "revision": self._revision, "issuer": self.issuer, **more}
        payload = json.dumps(order).encode()
        accepted, refused, silent, outdated = [], {}, [], []
        for i, answer in self.link.ask(ids, "command", payload, timeout_s, RETRY_S).items():
            said = _object(answer)
            if said is None:
                silent.append(i)
                continue
            self._revision = max(self._revision, _command_rank(said)[0])
            if said.get("accepted") is True:
                accepted.append(i)
                continue
            refused[i] = str(said.get("reason"))
            if _outdated(order, said):
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
        accounts = {i: _account(a) for i, a in answers.items()}
        boots = {i: {a.boot_id} for i, a in accounts.items() if a is not None}
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
        return fleet_report(self.config, accounts, offsets, {i: frozenset(b) for i, b in boots.items()})

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
        newest = self._formed()
        return self._send(self.config.motion_home(newest, self._start_ns(newest, now_ns), 0), newest)

    def form(self, shape: str, now_ns: int) -> Answers:
        """Another formation; RefusedError if nobody says where the fleet is, ConfigError for an unknown shape."""
        self.config.slots(shape)
        newest = self._formed()
        # Slots that are still on their way to the last formation arrive there first.
        start_ns = max(self._start_ns(newest, now_ns), newest.blend_end_ns)
        return self._send(self.config.motion_into(shape, newest, start_ns, 0), newest)

    def move(self, leg: Leg, now_ns: int) -> Answers:
        """Another motion of the formation; RefusedError before it has formed by itself."""
        newest = self._formed()
        motion = with_legs(newest, at_ns=self._start_ns(newest, now_ns), issuer=0, legs=(leg,))
        if abs(motion.climb_at_end_m_s) > 1e-6:
            raise RefusedError("the formation would climb or sink for ever: give it a place and an altitude to go to")
        return self._send(motion, newest)

    def goto(self, north_m: float, east_m: float, altitude_m: float | None, speed_m_s: float, now_ns: int) -> Answers:
        """Fly the formation's centre to a point of the fleet frame and stop there."""
        newest = self._formed()
        start_ns = self._start_ns(newest, now_ns)
        here = newest.moment(start_ns).centre
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

    def _formed(self) -> Motion:
        newest = self._newest()
        if newest.revision == 0 and self.config.plan.automatic:
            # A motion of ours would take the place of the one by which the vehicles form.
            raise RefusedError("the fleet is not in formation yet")
        return newest

    def _newest(self) -> Motion:
        motions = []
        for said in self.status().values():
            if said is not None:
                try:
                    motions.append(decode_motion(json.dumps(said["motion"]).encode()))
                except WireError as error:
                    raise RefusedError(
                        f"vehicle {said['vehicle']} tells a plan that cannot be read: {error}"
                    ) from error
        if not motions:
            raise RefusedError("no vehicle answers; is the fleet up, and is this its fleet.toml?")
        return max(motions, key=lambda m: m.order)

    def _start_ns(self, newest: Motion, now_ns: int) -> int:
        return max(now_ns + COMMAND_LEAD_NS, newest.start_ns + 1)

    def _send(self, motion: Motion, newest: Motion) -> Answers:
        """Command a motion; RefusedError for one that every vehicle would refuse."""
        fault = examine(motion, self.config.motion_limits, newest).fault
        if fault is not None and not only_stops(motion, newest):
            raise RefusedError(fault.sentence)
        return self.command("motion", motion=json.loads(encode_motion(motion)))


def _account(answer: bytes | None) -> Account | None:
    """A vehicle's account; None from the silent, and from whoever answers anything else."""
    try:
        return None if answer is None else Account.model_validate_json(answer)
    except ValidationError:
        return None


def _clock_reading(answer: bytes) -> ClockReading | None:
    try:
        return ClockReading.model_validate_json(answer)
    except ValidationError:
        return None


def _object(answer: bytes | None) -> dict[str, Any] | None:
    """An answer's JSON object; None from the silent, and from whoever answers anything else."""
    try:
        said = None if answer is None else json.loads(answer)
    except (ValueError, RecursionError):
        return None
    return said if isinstance(said, dict) else None


def _command_rank(said: Mapping[str, Any]) -> tuple[int, str]:
    """Revision and issuer of the last command that a vehicle obeyed, as it tells; (0, "") from whoever tells none."""
    match said.get("command"):
        case [int(revision), str(issuer)] if not isinstance(revision, bool):
            return revision, issuer
    return 0, ""


def _outdated(order: Mapping[str, Any], said: Mapping[str, Any]) -> bool:
    """Whether a vehicle that refused has obeyed a newer command, or holds a newer motion, than this one."""
    if _command_rank(said) >= (order["revision"], order["issuer"]):
        return True
    held = said.get("revision")
    return order["verb"] == "motion" and isinstance(held, int) and held >= order["motion"]["revision"]


def velocity_leg(north_m_s: float, east_m_s: float, up_m_s: float) -> VelocityLeg:
    """Constant velocity until told otherwise."""
    return VelocityLeg(Ned(north_m_s, east_m_s, -up_m_s), 0.0)


def turn_leg(rate_deg_s: float, angle_deg: float | None) -> TurnLeg:
    """A turn through an angle, or circling (None)."""
    return TurnLeg(radians(rate_deg_s), float("inf") if angle_deg is None else angle_deg * pi / 180.0)
