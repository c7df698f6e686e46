"""Tests that fly a real PX4 SITL: they need a build of PX4 and its UDP ports for themselves."""

import os
import sys
from pathlib import Path

import pytest

from sim.launch.px4_build import find_build

HERE = Path(__file__).parent
for helpers in ("process", "wire"):
    sys.path.insert(0, str(HERE.parent / helpers))


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark what lies here, and skip it with the reason where there is no PX4."""
    build = os.environ.get("PX4_BUILD")
    for item in items:
        if HERE in item.path.parents:
            item.add_marker(pytest.mark.sitl)
            item.add_marker(pytest.mark.timeout(400))
            if not build:
                item.add_marker(pytest.mark.skip(reason="PX4_BUILD names no build folder of PX4 (docs/px4.md)"))


@pytest.fixture(scope="session")
def build() -> Path:
    """PX4's build folder; what is none fails each test at once."""
    return find_build(Path(os.environ["PX4_BUILD"]))
