"""How tests share the cores: what keeps real time runs one after another on a worker of its own, the rest beside it.

Processes, ports and Zenoh sessions want their time when it is due, so the first worker runs them all, at its full
priority. The other workers compute, in lockstep's own time, at a lower one. A file whose tests share one flight stays
together: its flight is flown once.
"""

import os

import pytest

TOGETHER = ("test_flight.py", "test_faults.py", "test_damaged_recordings.py")
"""files of tests/lockstep whose tests look at flights that they share"""
NICENESS = 10


def pytest_configure(config: pytest.Config) -> None:
    if getattr(config, "workerinput", {}).get("workerid", "gw0") != "gw0":
        os.nice(NICENESS)


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    first, then = [], []
    for item in items:
        folder, name = item.path.parent.name, item.path.name
        real_time = folder in ("process", "sitl")
        if real_time:
            item.add_marker(pytest.mark.xdist_group("real time"))
        elif folder == "lockstep" and name in TOGETHER:
            item.add_marker(pytest.mark.xdist_group(name))
        (first if real_time else then).append(item)
    # Groups are dealt out in the order of the tests, and lockstep's are the longest of the rest.
    then.sort(key=lambda item: item.path.parent.name != "lockstep")
    items[:] = first + then
