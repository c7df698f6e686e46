"""The companion computer looked over, as far as it can be without one."""

from pathlib import Path

import pytest

from companion.config import load
from companion.io.check import WRITE_BYTES, clock_check, disk_checks, hardware_checks, kernel_clock, write_speed_mb_s

FILE = Path(__file__).resolve().parents[2] / "fleet.toml"


@pytest.mark.parametrize(
    ("kernel", "value", "met"),
    [
        ((True, 0.012), "yes, to 0.012 s", True),
        ((True, 0.9), "yes, to 0.900 s", True),
        ((False, 16.0), "no", False),
        (None, "unknown", True),
    ],
)
def test_a_clock_is_synchronised_or_not_or_nobody_can_tell(
    kernel: tuple[bool, float] | None, value: str, met: bool
) -> None:
    row = clock_check(kernel)
    assert (row.value, row.passed) == (value, met)


def test_the_kernel_tells_of_its_clock_or_that_it_does_not() -> None:
    told = kernel_clock()
    assert told is None or (isinstance(told[0], bool) and told[1] >= 0.0)


def test_a_folder_is_written_to_and_left_as_it_was(tmp_path: Path) -> None:
    rows = {c.name: c for c in disk_checks(tmp_path)}
    assert rows["recording folder"].passed
    speed = rows["disk speed"].value
    assert isinstance(speed, float)
    assert speed > 0.0
    assert list(tmp_path.iterdir()) == []


def test_the_speed_is_what_was_written_over_the_time_it_took(tmp_path: Path) -> None:
    times = iter([10.0, 14.0])
    assert write_speed_mb_s(tmp_path, lambda: next(times)) == pytest.approx(WRITE_BYTES / 1e6 / 4.0)


def test_a_folder_that_is_not_there_is_named(tmp_path: Path) -> None:
    (row,) = disk_checks(tmp_path / "none")
    assert not row.passed
    assert row.message == f"{tmp_path / 'none'}: No such file or directory"


def test_a_serial_line_that_is_not_there_is_named_and_the_rest_is_looked_at(tmp_path: Path) -> None:
    config = load(FILE, lambda t: t["vehicle"][0].update(mavlink="serial:///dev/none:921600"))
    rows = []
    for row in hardware_checks(config, config.by_id(1), 1.0, tmp_path):
        rows.append(row)
        if row.name == "system clock":
            break
    assert [r.name for r in rows] == ["link", "system clock"]
    assert "cannot open serial line /dev/none" in rows[0].message
