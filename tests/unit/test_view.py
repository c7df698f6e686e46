"""What people see of a flight, on terminals of any width and whatever vehicles say."""

import io
import itertools
import json
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.console import Console
from statuses import status

from companion.errors import WireError
from companion.operator.views import status_table
from companion.wire.operator import Status, as_json, decode
from sim.launch.summary.view import show_summary
from sim.launch.view import FlightView
from sim.launch.watch import Progress

LONG = "its clock is 0.341 s behind that of vehicle 3, " * 12
REMARKS = st.text(max_size=300) | st.sampled_from([LONG, "[red]bold[/red]", "\x1b[2J\n\n\r\t", "飛行" * 60, ""])


def heard(odd: dict[str, Any]) -> Status | None:
    """What its reader makes of a status with odd values in it."""
    try:
        return decode(Status, json.dumps({**as_json(status()), **odd}).encode())
    except WireError:
        return None


def shown(vehicles: dict[int, Status | None], width: int, height: int | None = None) -> list[str]:
    """The table's lines as a terminal of that width has them."""
    console = Console(file=io.StringIO(), width=width, color_system=None)
    console.print(status_table(vehicles, {1: 0.11}, width=width, height=height))
    assert isinstance(console.file, io.StringIO)
    lines = console.file.getvalue().splitlines()
    assert all(Console(width=10_000).measure(line).maximum <= width for line in lines)
    return lines


WIDTHS = range(40, 201)


@pytest.mark.parametrize("remark", ["", "x", "a word or two", LONG, "y" * 500])
def test_every_vehicle_has_its_phase_and_error_on_a_line_at_any_width_and_with_any_remark(remark: str) -> None:
    for width in WIDTHS:
        lines = shown({1: status(failsafes=[remark]), 2: status(phase="moving"), 3: None}, width)
        rows = {line.split()[0]: line.split()[1:] for line in lines[2:5]}
        assert rows["1"][0] == "formed", (width, lines)
        assert rows["2"][0] == "moving"
        assert rows["3"][0] == "silent"
        assert "0.12" in rows["1"]
        assert "0.12" in rows["2"]


def test_a_wider_terminal_shows_no_less_and_the_widest_shows_all() -> None:
    columns = [len(shown({1: status()}, width)[2].split()) for width in WIDTHS]
    assert all(a <= b for a, b in itertools.pairwise(columns))
    assert columns[-1] == 11


@pytest.mark.parametrize("width", [40, 76, 80, 100, 130, 200])
def test_the_status_tells_every_word_of_a_remark_however_long(width: int) -> None:
    words = [f"word{k}" for k in range(120)]
    said = "".join("".join(shown({7: status(failsafes=[" ".join(words)])}, width)).split())
    assert all(word in said for word in words)


@settings(max_examples=150, deadline=None)
@given(
    st.dictionaries(st.integers(1, 250), REMARKS | st.none(), min_size=1, max_size=40),
    st.integers(40, 200), st.integers(6, 60),
)  # fmt: skip
def test_a_live_table_never_has_more_lines_than_the_terminal(
    remarks: dict[int, str | None], width: int, height: int
) -> None:
    vehicles = {i: None if remark is None else status(failsafes=[remark]) for i, remark in remarks.items()}
    lines = shown(vehicles, width, height)
    assert len(lines) <= height
    told = [int(word) for line in lines if (word := line.split()[0] if line.split() else "").isdigit()]
    assert len([i for i in told if i in vehicles]) >= min(len(vehicles), height - 3)


ODD = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=9),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
)


@settings(max_examples=150, deadline=None)
@given(st.dictionaries(st.sampled_from(sorted(as_json(status()))), ODD), st.integers(40, 200))
def test_whatever_a_vehicle_says_of_itself_the_others_are_shown(odd: dict[str, Any], width: int) -> None:
    lines = shown({1: heard(odd), 2: status(), 3: heard(dict([*odd.items()][:1]))}, width)
    assert any(line.split()[:2] == ["2", "formed"] for line in lines)


def test_a_killed_vehicle_is_shown_as_killed_whatever_its_phase_and_before_all_others() -> None:
    vehicles: dict[int, Status | None] = {i: status() for i in range(1, 10)}
    vehicles[9] = status(phase="landed", armed=False, killed="its motors stopped in the air")
    row = shown(vehicles, 160)[-1]
    assert row.split()[:2] == ["9", "killed"]
    assert "its motors stopped in the air" in row
    crowded = shown(vehicles, 100, 5)
    assert any(line.split()[:2] == ["9", "killed"] for line in crowded)
    assert "and 7 more" in crowded[-1]


def test_one_that_flees_is_told_as_that_before_its_failsafes() -> None:
    lines = shown({1: status(flees=True, failsafes=["battery low"]), 2: status()}, 200)
    assert ["flees; battery low" in line for line in lines if line.split()[:1] in (["1"], ["2"])] == [True, False]


def test_the_summary_shows_who_commanded_what_and_who_was_killed(capsys: pytest.CaptureFixture[str]) -> None:
    none = {"p50": None, "p99": None}
    estimates = {"formation_error_decorrelated_rms_m": None}
    steady = dict.fromkeys(
        (
            "formation_error_rms_m", "seconds", "velocity_error_rms_m_s", "centroid_error_rms_m",
            "messages_per_vehicle_hz", "reduction_vs_20hz_percent", "payload_bytes_per_vehicle_s",
            "packets_per_vehicle_hz", "packets_reduction_vs_20hz_percent", "wire_bytes_per_vehicle_s", "network",
        ),
        1.0,
    )  # fmt: skip
    show_summary(
        {
            "vehicles": 3, "formed_after_s": 20.0, "shape_formed_after_s": 19.0, "place_taken_after_s": 19.5,
            "minimum_distance_m": 3.0, "steady": steady,
            "estimates": estimates, "latency_ms": none,
            "loop_lateness_ms": none, "reference_lateness_ms": none, "cpu_per_tick_ms": None,
            "setpoint_gap_max_s": 0.1, "touchdown_max_m_s": 12.6, "killed": {3: "killed by command"}, "failsafes": [],
            "lost": [], "unrecorded": {}, "autopilots_lost": {2: "PX4 ended with status -9"}, "rejected": {},
            "passed": False, "judged_by": "truth",
            "commands": [
                {
                    "at_s": 31.4, "verb": "kill", "issuer": "operator-ab12", "id": "1f", "accepted": [3],
                    "refused": {"1": "[why] not"}, "unanswered": [2],
                }
            ],
            "criteria": [{"what": "vehicles killed", "limit": "<= 0", "value": 1, "met": False}],
        }
    )  # fmt: skip
    said = " ".join(capsys.readouterr().out.split())
    assert "31.4 s kill by operator-ab12: accepted by 1; vehicle 1 refused: [why] not; no answer: vehicle 2" in said
    assert "vehicle 3: killed by command" in said
    assert "vehicle 2: PX4 ended with status -9" in said
    assert said.endswith("not met: vehicles killed <= 0, got 1 not passed")


def test_without_a_terminal_a_vehicle_that_is_killed_is_told_at_once_and_once(
    capsys: pytest.CaptureFixture[str],
) -> None:
    flying, killed = status(phase="moving"), status(phase="released", killed="killed by command")
    with FlightView(quiet=False) as view:
        for elapsed_s, second in ((0.0, flying), (1.0, killed), (2.0, killed)):
            view.show_progress(Progress(elapsed_s, "flying", {1: flying, 2: second}, {}))
    told = capsys.readouterr().err.splitlines()
    assert [("vehicle 2: killed by command" in line, "1 killed" in line) for line in told] == [
        (False, False),
        (True, True),
    ]
