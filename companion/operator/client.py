"""The operator's side of a fleet: questions and commands to every vehicle, each acknowledged or named as silent.

The operator is no leader: a command is a new motion (or a verb), the same bytes to every vehicle, and each vehicle
decides for itself whether it takes it. A command says at which place (`wire.operator.Place`) it finds each vehicle.

What one vehicle answers is its own: an answer that cannot be read, or a plan that nobody could follow, leaves that
vehicle out, by name. Two companions that answer as one vehicle are two fleets, or one too many: they are refused.
"""

import secrets
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from math import inf, radians

from pydantic import ValidationError

from companion.config import FleetConfig
from companion.config.schema import GotoLegTable
from companion.core.frames import Ned
from companion.core.route import only_stops
from companion.core.trajectory.fleet import REVISIONS, FleetTrajectory
from companion.core.trajectory.legs import FreeLeg, Leg, TurnLeg, VelocityLeg
from companion.core.trajectory.successors import freed, going_on, with_legs
from companion.core.trajectory_check import examine
from companion.core.values import ZERO
from companion.errors import RefusedError, WireError
from companion.operator.clocks import clock_offsets
from companion.operator.newest import newest_motion, whereabouts
from companion.operator.preflight import FleetReport, fleet_report
from companion.operator.roster import RETRY_S, STATUS_TIMEOUT_S, Link, Roster
from companion.terminal import one_line
from companion.wire.operator import ENDING, Answer, Command, PreflightReport, Scare, Status, Verb, decode, encode
from companion.wire.peer import leg_to_json, motion_to_json

COMMAND_LEAD_NS = 2_000_000_000
"""how far ahead of now a commanded motion starts, so that every vehicle has it by then"""
ANSWER_TIMEOUT_S = 5.0
ENDING_TIMEOUTS_S = (1.0, 1.0, 2.0, 1.0)
"""what ends a flight is commanded anew after these, to whoever is silent or has begun another flight meanwhile"""
KILL_STATUS_TIMEOUT_S = 0.6
PREFLIGHT_TIMEOUT_S = 3.0
REASON_LENGTH_MAX = 500


class PreflightError(RefusedError):
    """The fleet is not fit to take off; `report` says why."""

    def __init__(self, report: FleetReport) -> None:
        super().__init__("not fit for take-off:\n" + "\n".join(f"  {fault}" for fault in report.faults))
        self.report = report


@dataclass(frozen=True, slots=True)
class Answers:
    """What the vehicles said to a command."""

    accepted: tuple[int, ...]
    refused: Mapping[int, str]
    """vehicle id -> its reason"""
    silent: tuple[int, ...]
    """nothing came from them that can be read"""
    outdated: tuple[int, ...] = ()
    """who refused since it has gone on: another place in the order of commands, a newer motion"""
    notes: tuple[str, ...] = ()
    """who was left out and why; what preflight warns of"""

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
        self.roster = Roster(config, link)
        self.ids = self.roster.ids
        self.issuer = f"operator-{secrets.token_hex(4)}" if issuer is None else issuer
        self.both = both
        """whether what ends a flight goes to both of two companions that answer as one vehicle"""

    def status(self, timeout_s: float = STATUS_TIMEOUT_S) -> dict[int, Status | None]:
        """Each vehicle's own account of itself; None from the silent and the unreadable (`roster` names those)."""
        return self.roster.ask(timeout_s)

    # -- commands ----------------------------------------------------------------------------------------------------

    def command(
        self, verb: Verb, vehicle: int | Iterable[int] | None = None, *, confirm: bool = False,
        motion: FleetTrajectory | None = None, leg: Leg | None = None, threat: Scare | None = None,
    ) -> Answers:  # fmt: skip
        """A verb to every vehicle, to one or to some, asked again until each has answered or the time is over.

        What ends a flight is commanded anew to whoever has begun another flight meanwhile, and to the silent, for whom
        nobody else waits; anything else to those alone whose place was not known.
        """
        named = (vehicle,) if isinstance(vehicle, int) else vehicle
        ids = self.ids if named is None else tuple(self.config.by_id(i).id for i in dict.fromkeys(named))
        self.roster.refuse_doubles(ids, verb, both=self.both)
        ending = verb in ENDING
        unknown = frozenset(i for i in ids if not self.roster.places(i))
        accepted: list[int] = []
        refused: dict[int, str] = {}
        for timeout_s in ENDING_TIMEOUTS_S if ending else (ANSWER_TIMEOUT_S, ANSWER_TIMEOUT_S):
            command = Command(
                verb=verb,
                id=secrets.token_hex(8),
                issuer=self.issuer,
                after={i: self.roster.places(i) for i in ids},
                confirm=confirm,
                motion=None if motion is None else motion_to_json(motion),
                leg=None if leg is None else leg_to_json(leg),
                threat=threat,
            )
            last = self._ask(ids, command, timeout_s, None if motion is None else motion.revision)
            accepted += last.accepted
            refused |= last.refused
            again = (*last.outdated, *last.silent) if ending else tuple(i for i in last.outdated if i in unknown)
            if not again:
                break
            ids, unknown = again, frozenset()
        refused = {i: reason for i, reason in refused.items() if i not in (*accepted, *last.silent)}
        return replace(last, accepted=tuple(sorted(accepted)), refused=refused)

    def _ask(self, ids: Iterable[int], command: Command, timeout_s: float, revision: int | None) -> Answers:
        """One command, the same bytes to each; `revision`: of its motion."""
        accepted, refused, silent, outdated, notes = [], {}, [], [], []
        for i, told in self.link.ask(ids, "command", encode(command), timeout_s, RETRY_S).items():
            answers = [_answer(t) for t in told]
            read = [a for a in answers if isinstance(a, Answer)]
            if not read:
                silent.append(i)
                notes += [f"vehicle {i}'s answer cannot be read: {a}" for a in answers[:1] if isinstance(a, str)]
                continue
            self.roster.note_places(i, [a.place for a in read])
            reasons = [one_line(str(a.reason), REASON_LENGTH_MAX) for a in read if not a.accepted]
            if not reasons:
                accepted.append(i)
                continue
            refused[i] = "; ".join(reasons)
            if len(read) > 1:
                refused[i] = f"two companions answer as this vehicle: {refused[i]}"
            if any(_outdated(a, revision) for a in read):
                outdated.append(i)
        return Answers(tuple(accepted), refused, tuple(silent), tuple(outdated), tuple(notes))

    def take_off(self) -> Answers:
        """Every vehicle arms and climbs; PreflightError if the fleet is not fit, and then nobody is asked to."""
        report = self.preflight()
        if not report.fit:
            raise PreflightError(report)
        self.status()
        answers = self.command("takeoff")
        return replace(answers, notes=(*answers.notes, *(f"warning: {w}" for w in report.warnings)))

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

    # -- preflight ---------------------------------------------------------------------------------------------------

    def preflight(self) -> FleetReport:
        """Every vehicle's own checks, and what they say compared."""
        told = self.link.ask(self.ids, "preflight", b"", PREFLIGHT_TIMEOUT_S, RETRY_S)
        reports: dict[int, PreflightReport | None] = dict.fromkeys(told)
        unreadable: dict[int, str] = {}
        boots: dict[int, set[int]] = {}
        for i, answers in told.items():
            for answer in answers:
                try:
                    report = decode(PreflightReport, answer)
                except WireError as error:
                    unreadable[i] = error.detail
                    continue
                reports[i] = reports[i] or report
                boots.setdefault(i, set()).add(report.boot_id)
        offsets, more = clock_offsets(self.link, boots, self.config.preflight.clock_limit_s)
        processes = {i: frozenset(boots[i] | more[i]) for i in boots}
        return fleet_report(self.config, reports, offsets, processes, unreadable)

    # -- motions -----------------------------------------------------------------------------------------------------

    def rtl(self, now_ns: int) -> Answers:
        """Back over the pads, each vehicle over its own, and land there; RefusedError before the fleet has formed."""
        return self._follow(now_ns, lambda newest, at_ns: self.config.motion_home(newest, at_ns, 0))

    def form(self, shape: str, now_ns: int) -> Answers:
        """Another formation; RefusedError if nobody says where the fleet is, ConfigError for an unknown shape."""
        self.config.slots(shape)

        def formation(newest: FleetTrajectory, at_ns: int) -> FleetTrajectory:
            # Slots that are still on their way to the last formation arrive there first.
            return self.config.motion_into(shape, newest, max(at_ns, newest.blend_end_ns), 0)

        return self._follow(now_ns, formation, keeps_free=True)

    def free(self, now_ns: int) -> Answers:
        """No motion is shared any more: the vehicles go on by what they tell each other."""
        return self._follow(now_ns, lambda newest, at_ns: with_legs(newest, at_ns=at_ns, issuer=0, legs=(FreeLeg(),)))

    def wish(self, leg: Leg | None, vehicles: Iterable[int]) -> Answers:
        """Some vehicles are told where to draw the fleet, which flies no shared motion; None: nowhere any more."""
        self.status()
        return self.command("wish", vehicles, leg=leg)

    def scare(self, threat: Scare, now_ns: int) -> Answers:
        """Every vehicle is told of a threat, which those near it flee; RefusedError where they share a motion, and then
        nobody is told."""
        statuses = self.status()
        self.roster.refuse_doubles(self.ids, "scare")
        newest = newest_motion(statuses, now_ns).motion
        if newest is None:
            raise RefusedError("no vehicle answers; is the fleet up, and is this its fleet.toml?")
        if not newest.free_at(now_ns):
            raise RefusedError("the fleet flies a motion that all share, and only a free one flees: move --free first")
        return self.command("scare", threat=threat)

    def move(self, leg: Leg, now_ns: int) -> Answers:
        """Another motion of the formation; RefusedError before it has formed by itself."""

        def moved(newest: FleetTrajectory, at_ns: int) -> FleetTrajectory:
            motion = with_legs(newest, at_ns=at_ns, issuer=0, legs=(leg,))
            if abs(motion.climb_at_end_m_s) > 1e-6:
                raise RefusedError(
                    "the formation would climb or sink for ever: give it a place and an altitude to go to"
                )
            return motion

        return self._follow(now_ns, moved)

    def goto(self, north_m: float, east_m: float, altitude_m: float | None, speed_m_s: float, now_ns: int) -> Answers:
        """Fly the formation's centre to a point of the fleet frame and stop there."""
        try:
            waypoint = GotoLegTable(
                kind="goto", north_m=north_m, east_m=east_m, altitude_m=altitude_m, speed_m_s=speed_m_s
            )
        except ValidationError as error:
            first = error.errors()[0]
            raise RefusedError(f"goto: {first['loc'][0]}: {first['msg']}, got {first['input']!r}") from error

        def moved(newest: FleetTrajectory, at_ns: int) -> FleetTrajectory:
            here = newest.state_at(at_ns).centre
            leg = self.config.waypoint(here.position, here.velocity, waypoint)
            return with_legs(newest, at_ns=at_ns, issuer=0, legs=(leg,))

        return self._follow(now_ns, moved)

    def hold(self, clock_ns: Callable[[], int]) -> Answers:
        """Stop where the formation is; once more from what is newest then, if a vehicle has a newer motion or command.

        A motion that one vehicle refuses for a newer one is soon replaced by that in all others too.
        """
        answers = self.move(VelocityLeg(ZERO, 0.0), clock_ns())
        return self.move(VelocityLeg(ZERO, 0.0), clock_ns()) if answers.outdated else answers

    def _follow(
        self, now_ns: int, next_motion: Callable[[FleetTrajectory, int], FleetTrajectory], *, keeps_free: bool = False
    ) -> Answers:
        """Command the motion that follows the newest one, from a time soon after now (`now_ns`: UTC).

        Where no motion is shared it begins where the vehicles say that they are; with `keeps_free` none is then either.
        RefusedError where there is none to follow, and for a motion that every vehicle would refuse.
        """
        statuses = self.status()
        self.roster.refuse_doubles(self.ids, "motion")
        found = newest_motion(statuses, now_ns)
        left_out = (*self.roster.left_out, *found.sentences)
        newest = found.motion
        if newest is None:
            raise RefusedError(
                "; ".join(left_out) or "no vehicle answers; is the fleet up, and is this its fleet.toml?"
            )
        if newest.revision + 1 >= REVISIONS:
            raise RefusedError("the revisions of motions are used up: land, and start the companions anew")
        if newest.revision == 0 and self.config.plan.automatic:
            # A motion of ours would take the place of the one by which the vehicles form.
            raise RefusedError("the fleet is not in formation yet")
        free = newest.free_at(now_ns)
        flown = going_on(newest, *_known(statuses, newest)) if free else newest
        motion = next_motion(flown, max(now_ns + COMMAND_LEAD_NS, newest.start_ns + 1))
        if free and keeps_free:
            motion = freed(motion)
        fault = examine(motion, self.config.motion_limits, newest).fault
        if fault is not None and not only_stops(motion, newest):
            raise RefusedError(fault.sentence)
        answers = self.command("motion", motion=motion)
        return replace(answers, notes=(*left_out, *answers.notes))


def _known(statuses: Mapping[int, Status | None], newest: FleetTrajectory) -> tuple[int, Ned, Ned]:
    at_ns, position, velocity = whereabouts(statuses, newest)
    return at_ns, Ned(*position), Ned(*velocity)


def _answer(told: bytes) -> Answer | str:
    """An answer, or what is wrong with it."""
    try:
        return decode(Answer, told)
    except WireError as error:
        return error.detail


def _outdated(answer: Answer, revision: int | None) -> bool:
    """Whether a vehicle that refused has gone on since: by a command, or to a motion as new as the commanded one."""
    newer = revision is not None and answer.revision is not None and answer.revision >= revision
    return newer or not answer.in_order


def velocity_leg(north_m_s: float, east_m_s: float, up_m_s: float) -> VelocityLeg:
    """Constant velocity until told otherwise."""
    return VelocityLeg(Ned(north_m_s, east_m_s, -up_m_s), 0.0)


def turn_leg(rate_deg_s: float, angle_deg: float | None) -> TurnLeg:
    """A turn through an angle, or circling (None)."""
    return TurnLeg(radians(rate_deg_s), inf if angle_deg is None else radians(angle_deg))
