"""A law and a trigger of another package fly as ours do, and what they do wrong ends nothing."""

import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from importlib.metadata import distributions
from math import dist, inf, nan
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from flights import fleet, straight
from foreign import EXAMPLE, install

from companion.core.frames import Ned
from companion.core.law.base import Law, Wanted
from companion.core.values import Phase
from companion.vehicle.guest import LAW_LIMITED, LAW_NOT_FINITE, LAW_RAISED, TRIGGER_RAISED, GuestLaw, GuestTrigger
from sim.lockstep.law_check import check, head_on, two_vehicles
from sim.lockstep.lockstep import Lockstep
from sim.lockstep.network import NetworkParameters

COUNT = 5


@pytest.fixture(scope="module")
def springs(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    site = install(EXAMPLE, tmp_path_factory.mktemp("springs") / "site")
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(site))
        yield site


def test_a_wheel_of_the_example_brings_what_the_tests_fly(springs: Path, tmp_path: Path) -> None:
    source = shutil.copytree(EXAMPLE, tmp_path / "source", ignore=shutil.ignore_patterns("build", "*.egg-info"))
    pip, offline = [sys.executable, "-m", "pip", "-q"], ["--no-deps", "--no-index"]
    wheel = ["wheel", *offline, "--no-build-isolation", "-w", str(tmp_path), str(source)]
    built = subprocess.run([*pip, *wheel], capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stdout + built.stderr
    (made,) = tmp_path.glob("*.whl")
    subprocess.run(
        [*pip, "install", *offline, "--no-compile", "--target", str(tmp_path / "site"), str(made)], check=True
    )
    installed, flown = (
        {(d.name, d.version): d for d in distributions(path=[str(s)])} for s in (tmp_path / "site", springs)
    )
    assert installed.keys() == flown.keys() == {("starling-springs", "0.1.0")}
    for name, of in installed.items():
        assert {(e.group, e.name, e.value) for e in of.entry_points} == {
            (e.group, e.name, e.value) for e in flown[name].entry_points
        }
    package = "starling_springs"
    assert {p.name: p.read_bytes() for p in (tmp_path / "site" / package).glob("*.py")} == {
        p.name: p.read_bytes() for p in (springs / package).glob("*.py")
    }


def foreign(tables: dict[str, Any]) -> None:
    tables["law"]["kind"] = "springs"
    tables["trigger"]["kind"] = "impatient"


def formed(ls: Lockstep) -> None:
    ls.run_until(3.0)
    ls.command(b'{"verb":"takeoff"}')
    ls.run_until(60.0, lambda: ls.all_in(Phase.FORMED, Phase.MOVING))
    assert ls.all_in(Phase.FORMED, Phase.MOVING), ls.notes


@pytest.mark.usefixtures("springs")
def test_a_foreign_law_and_trigger_take_a_lossy_fleet_into_formation_along_the_plan_and_down() -> None:
    config = fleet(COUNT, legs=straight(12.0), change=lambda t: (foreign(t), t["plan"].update(then="land"))[0])
    assert [(o.kind, o.package, o.version) for o in config.foreign] == [
        ("springs", "starling-springs", "0.1.0"), ("impatient", "starling-springs", "0.1.0"),
    ]  # fmt: skip
    ls = Lockstep(config, seed=2, network=NetworkParameters(delay_s=0.05, loss=0.2))
    formed(ls)
    agents = [v.agent for v in ls.vehicles.values()]
    told = [n.told for a in agents for n in a.neighbours]
    assert len(told) == COUNT * (COUNT - 1)
    assert all(len(t) == 2 for t in told), "the law's own numbers go round"
    assert any(t != (0.0, 0.0) for t in told)
    ls.run_until(200.0, lambda: ls.all_in(Phase.LANDED))
    assert ls.all_in(Phase.LANDED)
    rows = ls.truth().reshape(-1, COUNT)["position_ned_m"]
    gaps = [np.linalg.norm(rows[:, i] - rows[:, j], axis=1).min() for i in range(COUNT) for j in range(i)]
    assert min(gaps) > 1.0
    assert not any(a.rejected[LAW_RAISED] + a.rejected[LAW_NOT_FINITE] + a.rejected[TRIGGER_RAISED] for a in agents)
    assert sum(a.publisher.sent_because["triggered"] for a in agents) > 0


@pytest.mark.usefixtures("springs")
@pytest.mark.parametrize("name", ["springs", "starling", "paper", "intent"])
def test_every_law_passes_its_check(name: str) -> None:
    rows = list(check(name))
    assert [r for r in rows if not r.passed] == []
    assert len(rows) == 10


@pytest.mark.usefixtures("springs")
@pytest.mark.parametrize("name", ["starling", "springs"])
def test_the_check_sends_two_vehicles_so_that_they_collide_without_the_filter(name: str) -> None:
    assert head_on(two_vehicles({"kind": name}, barrier=False), 1)[0] < 0.5


class RogueError(Exception):
    """What no code of ours raises."""


@dataclass
class Rascal:
    """A sound law that goes wrong in some way, once told to."""

    sound: Law
    way: str = ""
    fields: tuple[str, ...] = ()
    told: list[str] = field(default_factory=list)

    def command(self, ego: Any, reference: Any, neighbours: Any, *, alone: bool) -> Any:
        wanted = self.sound.command(ego, reference, neighbours, alone=alone)
        residual = wanted.residual_ned_m
        match self.way:
            case "raises":
                raise RogueError("no")
            case "ends":
                raise SystemExit(3)
            case "recurs":
                return self.command(ego, reference, neighbours, alone=alone)
            case "none":
                return None
            case "nan":
                return Wanted(Ned(nan, 0.0, 0.0), residual)
            case "nan residual":
                return Wanted(wanted.acceleration_ned_m_s2, Ned(0.0, inf, 0.0))
            case "text":
                return Wanted(("a", "b", "c"), residual)  # type: ignore[arg-type]
            case "huge":
                return Wanted(Ned(1e300, 1e300, 0.0), residual)
            case "alters":
                for change in (
                    lambda: setattr(ego, "position_ned_m", ego.velocity_ned_m_s),
                    lambda: setattr(neighbours, "extra", 1),
                    lambda: setattr(neighbours[0], "in_formation", False),
                ):
                    with pytest.raises(AttributeError):
                        change()
                    self.told.append("refused")
        return wanted

    def reset(self) -> None:
        if self.way == "raises":
            raise RogueError("no")

    def tell(self) -> tuple[float, ...]:
        return ()


def flying(way: str) -> tuple[Lockstep, Rascal]:
    """Three vehicles in formation, of which the second is then flown by a law that goes wrong."""
    ls = Lockstep(fleet(3, legs=straight(60.0)), seed=4)
    agent = ls.vehicles[2].agent
    rascal = Rascal(agent.law)
    agent.law = GuestLaw(rascal, 5.0, agent.rejected)
    formed(ls)
    ls.run_until(ls.now_ns * 1e-9 + 3.0)
    rascal.way = way
    return ls, rascal


@pytest.mark.parametrize("way", ["raises", "ends", "recurs", "none", "text", "nan", "nan residual"])
def test_a_law_that_raises_or_says_nothing_finite_brakes_the_vehicle_is_counted_and_ends_nothing(way: str) -> None:
    ls, rascal = flying(way)
    agent = ls.vehicles[2].agent
    sent = agent.setpoints_sent
    ls.run_until(ls.now_ns * 1e-9 + 1.5)
    assert agent.setpoints_sent - sent > 60, "a setpoint in every tick all the same"
    assert agent.rejected[LAW_NOT_FINITE if way.startswith("nan") else LAW_RAISED] > 60
    assert agent.safety.counts["command not finite: braking"] > 60
    velocity = ls.vehicles[2].autopilot.truth().velocity_ned_m_s
    assert dist(velocity[:2], (0.0, 0.0)) < 0.5, "it brakes from 1 m/s"
    rascal.way = ""
    ls.run_until(ls.now_ns * 1e-9 + 5.0)
    assert agent.phase is Phase.MOVING, "and flies on with a law that is sound again"
    assert ls.vehicles[2].autopilot.truth().velocity_ned_m_s.north > 0.5


def test_a_law_that_asks_for_the_moon_gets_its_limit_and_the_filter_keeps_the_others_apart() -> None:
    ls, _ = flying("huge")
    agent = ls.vehicles[2].agent
    begin_ns = ls.now.fleet_ns
    ls.run_until(ls.now_ns * 1e-9 + 4.0)
    assert agent.rejected[LAW_LIMITED] > 100
    rows = ls.truth().reshape(-1, 3)
    kept = rows["position_ned_m"][rows["time_unix_ns"][:, 0] >= begin_ns]
    assert min(dist(p[1], p[k]) for p in kept for k in (0, 2)) > 0.5


def test_a_law_cannot_change_what_it_is_given() -> None:
    ls, rascal = flying("alters")
    ls.run_until(ls.now_ns * 1e-9 + 0.5)
    assert len(rascal.told) >= 60
    assert ls.vehicles[2].agent.rejected[LAW_RAISED] == 0


@dataclass
class Mute:
    """A trigger that raises."""

    waits: bool = False
    cause: str = "nothing"

    def fires(self, now: Any) -> bool:
        raise RogueError("no")

    def error_bound_m(self, motion: Any) -> float:
        return 0.5


def test_a_trigger_that_raises_speaks_as_often_as_t_min_allows() -> None:
    ls = Lockstep(fleet(2), seed=4)
    agent = ls.vehicles[1].agent
    agent.publisher.trigger = GuestTrigger(Mute(), False, agent.rejected)
    ls.run_until(3.0)
    before = agent.publisher.messages_sent
    ls.run_until(5.0)
    assert 20 <= agent.publisher.messages_sent - before <= 41, "t_min is 0.05 s"
    assert agent.rejected[TRIGGER_RAISED] > 20
