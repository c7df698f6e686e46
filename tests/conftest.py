"""How tests share the cores: what keeps real time in two lanes of its own, what computes beside them.

Processes, ports and Zenoh sessions want their time when it is due and mostly wait, so the first two workers begin with
them, one after another, at full priority. The other workers compute, in lockstep's own time, at a lower one. A file
whose tests share a flight stays together: its flight is flown once.
"""

import os

import pytest

FLEETS = ("test_fleet_up.py",)
"""files of tests/process that fly whole fleets: half of the time of all"""
TOGETHER = ("test_flight.py", "test_faults.py", "test_damaged_recordings.py")
"""files of tests/lockstep whose tests look at flights that they share"""
COMPILED = ("test_swarm.py", "test_swarm_lockstep.py", "test_study.py")
"""files of tests/unit that compile the swarm: once for all of them"""
LANES = 2
NICENESS = 10


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers() -> int:
    """One worker more than there are cores, since the lanes mostly wait."""
    return max((os.cpu_count() or 1) + 1, LANES)


def pytest_configure(config: pytest.Config) -> None:
    worker = getattr(config, "workerinput", {}).get("workerid", "gw0")
    if int(worker.removeprefix("gw")) >= LANES:
        os.nice(NICENESS)
    config.pluginmanager.register(Order())


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Say what stays together; xdist reads it when its own turn comes, before the order is settled."""
    for item in items:
        folder, name = item.path.parent.name, item.path.name
        if folder in ("process", "sitl"):
            item.add_marker(pytest.mark.xdist_group("fleets" if folder == "sitl" or name in FLEETS else "processes"))
        elif folder == "lockstep" and name in TOGETHER:
            item.add_marker(pytest.mark.xdist_group(name))
        elif folder == "unit" and name in COMPILED:
            item.add_marker(pytest.mark.xdist_group("compiled"))


class Order:
    """Settles the order of the tests, after whoever shuffles them."""

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        # Groups are dealt out in the order of the tests: the lanes first, next what is longest of the rest.
        items.sort(key=_turn)


def _turn(item: pytest.Item) -> int:
    folder, name = item.path.parent.name, item.path.name
    if folder in ("process", "sitl"):
        return 0 if name in FLEETS else 1
    return 2 if name in COMPILED else 3 if folder == "lockstep" else 4
