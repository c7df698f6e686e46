"""The launcher's watch over a flight, on a clock of its own."""

import json
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import pytest
import statuses

from companion.errors import CompanionError
from companion.operator.client import Answers
from companion.wire.operator import Status
from sim.launch.ended import ENDED_FILE, read_ended, tell_ended
from sim.launch.processes import how_it_ended
from sim.launch.watch import LANDING_TIMEOUT_S, POLL_S, UNHEARD_S, MissingError, Progress, Watch

Said = dict[int, Status | None]


def status(phase: str, armed: bool = True, age_s: float | None = 0.5) -> Status:
    return statuses.status(phase=phase, armed=armed, autopilot_age_s=age_s)


@dataclass
class Fleet:
    """Vehicles as their operator hears them, and processes as their launcher has them, at each second."""

    folder: Path
    vehicles: Callable[[float], Said]
    now_s: float = 0.0
    landed_at_s: float | None = None
    """when landing was commanded"""
    ended: dict[str, int] = field(default_factory=dict)
    shown: list[Progress] = field(default_factory=list)
    children: dict[str, object] = field(default_factory=dict)
    told: list[tuple[float, str]] = field(default_factory=list)
    """when, and what was said beside the live table"""

    def status(self) -> Said:
        return self.vehicles(self.now_s)

    def land(self) -> None:
        self.landed_at_s = self.now_s

    def exit_status(self, name: str) -> int | None:
        return self.ended.get(name)

    def take_off(self) -> Answers:
        return Answers((1, 2, 3), {}, ())

    def why_ended(self, name: str, when: str) -> str:
        return f"{name} ended {when} with {how_it_ended(self.ended[name])}:"

    def sleep(self, seconds: float) -> None:
        self.now_s += seconds

    def watch(self, allow_missing: bool = False) -> Watch:
        fleet: Any = self
        return Watch(
            fleet, fleet, [1, 2, 3], self.shown.append, 0.0, allow_missing=allow_missing,
            tell=lambda line: self.told.append((self.now_s, line)), clock=lambda: self.now_s, sleep=self.sleep,
        )  # fmt: skip


def landing(third: Callable[[float], Status | None]) -> Callable[[float], Said]:
    """Two vehicles that have landed by 20 s, and a third."""

    def said(now_s: float) -> Said:
        one = status("moving") if now_s < 20.0 else status("landed", armed=False)
        return {1: one, 2: one, 3: third(now_s)}

    return said


def test_a_vehicle_whose_autopilot_has_ended_is_named_and_keeps_nobody_waiting(tmp_path: Path) -> None:
    fleet = Fleet(tmp_path, landing(lambda now_s: status("released", age_s=now_s)))
    tell_ended(tmp_path, 3, "PX4 ended with status -9")
    watch = fleet.watch()
    assert watch.fly(None, (), lambda: False) == frozenset()
    assert fleet.now_s <= 20.0 + POLL_S
    assert watch.autopilots_ended() == {3: "PX4 ended with status -9"}
    assert fleet.shown[-1].autopilots_ended == {3: "PX4 ended with status -9"}


def test_an_autopilot_that_nobody_hears_keeps_nobody_waiting_for_long(tmp_path: Path) -> None:
    fleet = Fleet(tmp_path, landing(lambda now_s: status("released", age_s=max(now_s - 15.0, 0.5))))
    fleet.watch().fly(None, (), lambda: False)
    assert fleet.now_s == pytest.approx(15.0 + UNHEARD_S, abs=2 * POLL_S)


def test_one_that_flies_on_is_landed_and_waited_for_until_the_time_is_up(tmp_path: Path) -> None:
    fleet = Fleet(tmp_path, landing(lambda _: status("moving")))
    fleet.watch().fly(30.0, (), lambda: False)
    assert fleet.landed_at_s == 30.0
    assert fleet.now_s == pytest.approx(30.0 + LANDING_TIMEOUT_S, abs=2 * POLL_S)


def test_a_fleet_whose_every_autopilot_or_companion_has_ended_is_over(tmp_path: Path) -> None:
    fleet = Fleet(tmp_path, lambda _: {1: None, 2: status("released"), 3: status("released")})
    fleet.ended = {"companion-1": -9}
    for i in (2, 3):
        tell_ended(tmp_path, i, "PX4 ended with status 1")
    assert fleet.watch().fly(None, (), lambda: False) == {1}
    assert fleet.now_s == 0.0


def test_an_autopilot_that_ends_before_take_off_is_named_at_once(tmp_path: Path) -> None:
    fleet = Fleet(tmp_path, lambda _: dict.fromkeys((1, 2, 3)))
    tell_ended(tmp_path, 2, "PX4 ended with status -11")
    with pytest.raises(CompanionError, match="vehicle 2: PX4 ended with status -11 before take-off"):
        fleet.watch().take_off(30.0, lambda: False)


def coming(third: Callable[[float], Status | None]) -> Callable[[float], Said]:
    """Two vehicles that are ready, and a third."""
    return lambda now_s: {1: status("idle"), 2: status("idle"), 3: third(now_s)}


def unheard() -> Status:
    """A companion that has heard no autopilot yet."""
    return replace(status("idle"), autopilot_age_s=None, ready=["no heartbeat from the autopilot"])


@pytest.mark.parametrize(
    ("third", "why"), [(None, "its companion does not answer"), (unheard(), "its autopilot is not heard")]
)
def test_who_does_not_come_is_named_once_within_fifteen_seconds_and_waited_for(
    tmp_path: Path, third: Status | None, why: str
) -> None:
    fleet = Fleet(tmp_path, coming(lambda now_s: third if now_s < 40.0 else status("idle")))
    assert fleet.watch().take_off(120.0, lambda: False).all_accepted
    ((at_s, line),) = fleet.told
    assert at_s <= 15.0
    assert line == f"vehicle 3 has not come: {why} (--allow-missing flies without)"
    assert fleet.now_s == pytest.approx(40.0, abs=POLL_S)


def test_where_a_vehicle_may_be_missing_nobody_waits_longer_than_fifteen_seconds(tmp_path: Path) -> None:
    fleet = Fleet(tmp_path, coming(lambda _: None))
    with pytest.raises(MissingError) as raised:
        fleet.watch(allow_missing=True).take_off(120.0, lambda: False)
    assert raised.value.vehicles == {3: "its companion does not answer"}
    assert 10.0 < fleet.now_s <= 15.0


def test_a_companion_that_ends_before_take_off_may_be_missing_and_else_ends_the_launch(tmp_path: Path) -> None:
    fleet = Fleet(tmp_path, coming(lambda _: None), ended={"companion-3": -11})
    with pytest.raises(CompanionError, match=r"^companion-3 ended before take-off with status -11 \(SIGSEGV\)"):
        fleet.watch().take_off(120.0, lambda: False)
    with pytest.raises(MissingError, match="vehicle 3 has not come: companion-3 ended before"):
        fleet.watch(allow_missing=True).take_off(120.0, lambda: False)
    assert fleet.now_s == 0.0


def test_a_vehicle_that_is_late_is_not_missing(tmp_path: Path) -> None:
    fleet = Fleet(tmp_path, coming(lambda now_s: None if now_s < 9.0 else status("idle")))
    assert fleet.watch(allow_missing=True).take_off(120.0, lambda: False).all_accepted
    assert fleet.told == []


def test_word_of_an_autopilots_end_that_is_half_written_is_not_read(tmp_path: Path) -> None:
    assert read_ended(tmp_path) == {}
    tell_ended(tmp_path, 1, "x")
    with (tmp_path / ENDED_FILE).open("a") as file:
        file.write(json.dumps([2, "y"])[:5])
    assert read_ended(tmp_path) == {1: "x"}
