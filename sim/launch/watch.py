"""The launcher's eye on a flight: who is missing, who is ready, who has gone, when all is over."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from companion.errors import CompanionError
from companion.operator.client import Answers, Operator, PreflightError
from companion.wire.operator import Status
from sim.launch.ended import read_ended
from sim.launch.faults import CompanionFault, ScheduledFault, order_fault
from sim.launch.processes import FleetProcesses

MISSING_AFTER_S = 12.0
"""a vehicle that nobody has heard so long after the start of its companion is missing: it is named within 15 s"""
PARAMETERS_GRACE_S = 12.0
"""whoever runs the autopilots says by itself, and a little later, which parameter was not as set"""
LANDING_TIMEOUT_S = 90.0
POLL_S = 1.0
STARTING_POLL_S = 0.3
TAKE_OFF_GRACE_S = 15.0
"""a vehicle that is still on the ground by then has given its take-off up"""
UNHEARD_S = 15.0
"""an autopilot silent for so long will not tell of its landing any more"""

Said = Mapping[int, Status | None]


class MissingError(CompanionError):
    """Vehicles have not come; `vehicles` says why, by id."""

    def __init__(self, vehicles: Mapping[int, str]) -> None:
        super().__init__("; ".join(f"vehicle {i} has not come: {why}" for i, why in sorted(vehicles.items())))
        self.vehicles = dict(vehicles)


@dataclass(slots=True)
class Progress:
    """What the live table shows."""

    elapsed_s: float
    doing: str
    vehicles: Said
    ended: Mapping[int, int]
    """vehicle -> exit status of its companion, where it has ended"""
    autopilots_ended: Mapping[int, str] = field(default_factory=dict)
    """vehicle -> how its autopilot has ended"""


@dataclass(slots=True)
class Watch:
    """It asks once a second, shows, and notices who has gone."""

    operator: Operator
    processes: FleetProcesses
    ids: list[int]
    show: Callable[[Progress], None]
    began: float
    """when the flight's processes were started"""
    since: float = 0.0
    """when the companions were started"""
    ready: Path | None = None
    """a file that is there once the autopilots have their parameters; None: nobody sets any here"""
    allow_missing: bool = False
    landing_s: float = LANDING_TIMEOUT_S
    tell: Callable[[str], None] = lambda _: None
    """says what cannot wait for the live table, once"""
    harm: Callable[[int, CompanionFault], None] = lambda _, __: None
    """has a companion's process suffer a fault"""
    refused: list[str] = field(default_factory=list)
    """faults that were ordered, and not carried out"""
    said: dict[int, Status] = field(default_factory=dict)
    """each vehicle's last account"""
    asked_ns: int = 0
    """when the take-off was last commanded (UTC)"""
    clock: Callable[[], float] = time.monotonic
    sleep: Callable[[float], None] = time.sleep
    _told_missing: dict[int, str] = field(default_factory=dict)

    def _look(self, doing: str) -> dict[int, Status | None]:
        answers = self.operator.status()
        self.said.update({i: s for i, s in answers.items() if s is not None})
        self.show(Progress(self.clock() - self.began, doing, answers, self.ended(), self.autopilots_ended()))
        return answers

    def ended(self) -> dict[int, int]:
        """Companions that have ended, with their exit status."""
        status = {i: self.processes.exit_status(f"companion-{i}") for i in self.ids}
        return {i: s for i, s in status.items() if s is not None}

    def autopilots_ended(self) -> dict[int, str]:
        """Autopilots whose own process has ended, and how."""
        return read_ended(self.processes.folder)

    # -- before take-off ------------------------------------------------------------------------------------------

    def take_off(self, timeout_s: float, interrupted: Callable[[], bool]) -> Answers:
        """Wait until every vehicle is ready, look at the fleet as a whole, and take off.

        Raises MissingError where the fleet may fly without those who have not come, and PreflightError as soon as a
        fault shows that no waiting heals, and when the time is up.
        """
        deadline = self.clock() + timeout_s
        while True:
            self._until_ready(deadline, interrupted)
            self.asked_ns = time.time_ns()
            try:
                if self._parametrised:
                    return self.operator.take_off()
                if (report := self.operator.preflight()).permanent:
                    raise PreflightError(report)
            except PreflightError as error:
                if error.report.permanent or self.clock() > deadline:
                    raise
            if not self._parametrised and self.clock() > deadline + PARAMETERS_GRACE_S:
                raise CompanionError("the autopilots' parameters were not read back as set in time; nobody took off")
            self.sleep(STARTING_POLL_S)

    @property
    def _parametrised(self) -> bool:
        return self.ready is None or self.ready.exists()

    def _until_ready(self, deadline: float, interrupted: Callable[[], bool]) -> None:
        """Wait until every vehicle says that it may take off, or one that it cannot, or the time is up."""
        unfit_before = False
        while True:
            self._refuse_ended()
            answers = self._look("starting")
            self._name_missing(answers)
            if self._parametrised and all(s is not None and not s.ready for s in answers.values()):
                return
            if interrupted():
                raise CompanionError("interrupted before take-off")
            # Once all speak, so that all are named; seen twice, since what comes in at the start has no order.
            unfit = all(s is not None for s in answers.values()) and any(s.unfit for s in answers.values() if s)
            if (unfit and unfit_before) or self.clock() > deadline:
                return
            unfit_before = unfit
            self.sleep(STARTING_POLL_S)

    def _refuse_ended(self) -> None:
        """Whatever ends before take-off: a companion and an autopilot may be left out, the rest is needed."""
        gone = {i: self.processes.why_ended(f"companion-{i}", "before take-off") for i in self.ended()}
        gone |= {i: f"{how} before take-off" for i, how in self.autopilots_ended().items() if i in self.ids}
        if gone and self.allow_missing:
            raise MissingError(gone)
        for i, why in gone.items():
            raise CompanionError(why if why.startswith("companion-") else f"vehicle {i}: {why}")
        for name in self.processes.children:
            if self.processes.exit_status(name) is not None:
                raise CompanionError(self.processes.why_ended(name, "before take-off"))

    def _name_missing(self, answers: Said) -> None:
        """Say once who has not come MISSING_AFTER_S after the start; MissingError if the fleet may fly without."""
        if self.clock() - self.since < MISSING_AFTER_S:
            return
        missing = {i: why for i, s in answers.items() if (why := _absence(s)) is not None}
        if missing and self.allow_missing:
            raise MissingError(missing)
        if news := {i: why for i, why in missing.items() if self._told_missing.get(i) != why}:
            self._told_missing |= news
            self.tell(f"{MissingError(news)} (--allow-missing flies without)")

    # -- in flight ------------------------------------------------------------------------------------------------

    def fly(
        self, duration_s: float | None, faults: tuple[ScheduledFault, ...], interrupted: Callable[[], bool]
    ) -> frozenset[int]:
        """Watch until all have landed; returns the vehicles whose companion ended before."""
        start = self.clock()
        coming = list(faults)
        landing_since: float | None = None
        while True:
            answers = self._look("landing" if landing_since is not None else "flying")
            lost = frozenset(self.ended())
            gone = lost | frozenset(self.autopilots_ended())
            staying = [s for i, s in answers.items() if i not in gone and s is not None]
            if gone >= frozenset(self.ids):
                return lost
            if "autopilots" in self.processes.children and self.processes.exit_status("autopilots") is not None:
                raise CompanionError(self.processes.why_ended("autopilots", "in flight"))
            tried = self.clock() - start > TAKE_OFF_GRACE_S
            down = ("landed", "released", "idle") if tried else ("landed", "released")
            done = [(s.phase in down and not s.armed) or _unheard(s) for s in staying]
            if staying and all(done) and len(staying) + len(gone & frozenset(self.ids)) == len(self.ids):
                return lost
            while coming and self.clock() - start >= coming[0].at_s:
                self._suffer(coming.pop(0))
            over = duration_s is not None and self.clock() - start >= duration_s
            if landing_since is None and (over or interrupted()):
                landing_since = self.clock()
                self.operator.land()
            if landing_since is not None and self.clock() - landing_since > self.landing_s:
                return lost
            self.sleep(self._until_next(coming, start))

    def _until_next(self, coming: Sequence[ScheduledFault], start: float) -> float:
        """How long to wait for the next look: a fault comes at its time."""
        if not coming:
            return POLL_S
        return min(max(start + coming[0].at_s - self.clock(), 0.0), POLL_S)

    def _suffer(self, scheduled: ScheduledFault) -> None:
        """Carry out one line of a scenario; of one that cannot be, a word is said and the flight goes on."""
        fault = scheduled.fault
        if isinstance(fault, CompanionFault):
            self.harm(scheduled.vehicle_id, fault)
            return
        try:
            order_fault(self.operator.config, scheduled.vehicle_id, fault)
        except CompanionError as error:
            self.refused.append(f"fault {fault.kind} at {scheduled.at_s:g} s: {error}")
            self.tell(self.refused[-1])


def _absence(status: Status | None) -> str | None:
    """Why a vehicle has not come; None if it has."""
    if status is None:
        return "its companion does not answer"
    return "its autopilot is not heard" if status.autopilot_age_s is None else None


def _unheard(status: Status) -> bool:
    """Whether a vehicle's autopilot has said nothing for so long that nobody need wait for it to land."""
    return status.autopilot_age_s is not None and status.autopilot_age_s > UNHEARD_S
