"""How tests share the cores: what keeps real time in two lanes of its own, what computes beside them.

Processes, ports and Zenoh sessions want their time when it is due and mostly wait, so the first two workers begin with
them, one after another, at full priority. The other workers compute, in lockstep's own time, at a lower one. A file
whose tests share a flight stays together: its flight is flown once.
"""

import os
from typing import Any

import pytest

FLEETS = ("test_companions.py", "test_fleet_losses.py", "test_fleet_up.py", "test_missing.py")
"""files of tests/process that fly whole fleets: half of the time of all"""
TOGETHER = (
    "test_flight.py",
    "test_faults.py",
    "test_damaged_recordings.py",
    "test_intent_flight.py",
    "test_leaderless.py",
)
"""files of tests/lockstep whose tests look at flights that they share"""
COMPILED = (
    "test_evasion_study.py",
    "test_foreign_study.py",
    "test_study.py",
    "test_swarm.py",
    "test_swarm_lockstep.py",
    "test_swarm_scenes.py",
    "test_worth.py",
)
"""files of tests/unit that compile the swarm: once for all of them"""
LANES = 2
NICENESS = 10


def lane(nodeid: str) -> str:
    """What is run by one worker, one test after another: tests of one lane, else each test by itself."""
    folder, name = nodeid.split("::", maxsplit=1)[0].split("/")[-2:]
    if folder in ("process", "sitl"):
        return "fleets" if folder == "sitl" or name in FLEETS else "processes"
    if folder == "lockstep" and name in TOGETHER:
        return name
    return "compiled" if name in COMPILED else nodeid


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers() -> int:
    """One worker more than there are cores, since the lanes mostly wait."""
    return max((os.cpu_count() or 1) + 1, LANES)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    from xdist.scheduler import LoadScopeScheduling

    class Lanes(LoadScopeScheduling):
        def _split_scope(self, nodeid: str) -> str:
            return lane(nodeid)

    # Dealt out in the order of the items, as they are sorted below, not the lane of most tests first: what keeps real
    # time would wait, and run on the worker that gives way.
    config.option.loadscopereorder = False
    return Lanes(config, log)


def pytest_configure(config: pytest.Config) -> None:
    worker = getattr(config, "workerinput", {}).get("workerid", "gw0")
    if int(worker.removeprefix("gw")) >= LANES:
        os.nice(NICENESS)


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    # Lanes are dealt out in the order of the tests: what keeps real time first, next what is longest of the rest.
    items.sort(key=lambda item: _turn(lane(item.nodeid), item.path.parent.name))


def _turn(of: str, folder: str) -> int:
    order = ("fleets", "processes", "compiled")
    return order.index(of) if of in order else 3 if folder == "lockstep" else 4
