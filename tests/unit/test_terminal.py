"""Whatever vehicles, autopilots and files say, a terminal is shown printable characters, in bounds, and no command ends
by it."""

import io
import os
import re
import subprocess
import sys
from collections.abc import Iterable
from contextlib import redirect_stderr, redirect_stdout, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest import mock

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from statuses import status
from test_preflight_fleet import CONFIG, account

import companion.io.network
from companion.core.events import MotionAdopted, sentence
from companion.io.process import log_line
from companion.operator import verbs
from companion.terminal import LINE_MAX, TEXT_MAX, one_line, printable, tell
from companion.wire.operator import Answer, Check, ClockReading, Place, Status, encode
from sim.launch.summary.view import show_summary
from sim.launch.view import FlightView
from sim.launch.watch import Progress

WORST = (
    "\x1b[2J\x1b[H", "\x1b]0;title\x07", "\x9b2J", "[/red]", "[bold", "[link=file:///]x", ":warning:", "\u202emoc",
    "\r\nok", "\x00\x7f", "\u2028", "\ud800", "a" * 5000, " " * 5000, "\n" * 100, "飛" * 50, "e\u0301" * 40, "\\[x]",
    "{0}", "%s",
)  # fmt: skip
SAID = st.text(max_size=60) | st.sampled_from(WORST)
HEARD = SAID.filter(lambda s: not re.search("[\ud800-\udfff]", s)).map(lambda s: s[:4000])
"""what JSON can carry"""
QUICK = settings(max_examples=60, deadline=None)
WORDS = HEARD.map(lambda s: s[:64])


def shown(show: Any) -> str:
    """What a command prints on both streams; it ends by no error but its own status."""
    out, err = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(err), suppress(verbs.typer.Exit):
        show()
    said = out.getvalue() + err.getvalue()
    assert all(c.isprintable() or c == "\n" for c in said), said
    assert all(len(line) <= LINE_MAX for line in said.split("\n"))
    return said


class Said:
    """A link over which every vehicle answers with given bytes."""

    def __init__(self, answers: dict[str, bytes]) -> None:
        self.answers = answers

    def __enter__(self) -> "Said":
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def wait_alive(self, vehicle_ids: Iterable[int], timeout_s: float) -> frozenset[int]:
        return frozenset(vehicle_ids)

    def wait(self, seconds: float) -> None:
        pass

    def ask(
        self, vehicle_ids: Iterable[int], kind: str, payload: bytes, timeout_s: float, retry_s: float
    ) -> dict[int, tuple[bytes, ...]]:
        return {i: (self.answers[kind].replace(b'"vehicle": 1', b'"vehicle": %d' % i, 1),) for i in vehicle_ids}

    def ask_timed(
        self, vehicle_ids: Iterable[int], kind: str, payload: bytes, timeout_s: float, retry_s: float
    ) -> dict[int, tuple[bytes, int, int] | None]:
        reading = ClockReading(boot_id=7, received_ns=10**18, answered_ns=10**18)
        return {i: (encode(reading), 10**18, 10**18) for i in vehicle_ids}


FLEET_TOML = Path(__file__).resolve().parents[2] / "fleet.toml"


def over(verb: Any, told: dict[str, bytes], **more: Any) -> str:
    """What a verb shows to whom every vehicle gives these answers."""
    with mock.patch.object(companion.io.network, "operator_link", return_value=Said(told)):
        return shown(lambda: verb(FLEET_TOML, 2, **more))


@QUICK
@given(SAID, st.integers(1, 50))
def test_a_text_on_one_line_is_printable_and_as_long_as_allowed_at_most(said: str, most: int) -> None:
    line = one_line(said, most)
    assert line.isprintable()
    assert len(line) <= most
    if said.isprintable() and len(said) <= most and said == " ".join(said.split()):
        assert line == said


@QUICK
@given(SAID)
def test_a_text_of_several_lines_keeps_its_lines_and_loses_what_a_terminal_obeys(said: str) -> None:
    lines = printable(said).split("\n")
    assert all(line.isprintable() for line in lines)
    assert len(lines) == said.count("\n") + 1


def test_what_is_printable_is_told_as_it_is_and_what_is_cut_says_so(capsys: pytest.CaptureFixture[str]) -> None:
    tell("vehicle  3: 2.5 m, may be 2 m [x]\n  and more")
    tell("a\x1b[2J", error=True)
    came = capsys.readouterr()
    assert came.out == "vehicle  3: 2.5 m, may be 2 m [x]\n  and more\n"
    assert came.err == "a [2J\n"
    assert one_line("a" * TEXT_MAX) == "a" * TEXT_MAX
    assert one_line("a" * (TEXT_MAX + 1)) == "a" * (TEXT_MAX - 1) + "…"


@QUICK
@given(WORDS, HEARD, st.dictionaries(HEARD, st.integers(0, 9), max_size=2))
def test_the_status_shows_no_vehicles_control_characters(word: str, text: str, counts: Any) -> None:
    told = status(
        phase=word, mode=word, fleet=word, shape=word, killed=text or None, failsafes=[text, word], ready=[text],
        unfit=[text], rejected=counts, limited=counts, messages_by_cause=counts, armed=False, configuration=word,
    )  # fmt: skip
    said = over(verbs.status, {"status": encode(told)})
    assert "vehicle" in said
    over(verbs.status, {"status": encode(replace(told, phase="idle"))})
    over(verbs.status, {"status": b'{"vehicle": 1, "' + text.encode() + b'"'})


@QUICK
@given(WORDS, HEARD)
def test_a_verb_tells_what_a_vehicle_answers_without_its_control_characters(word: str, text: str) -> None:
    refusal = Answer(vehicle=1, accepted=False, reason=text, phase=word, place=Place(7, 1, 1))
    own = encode(status(fleet=word))
    for answer in (encode(refusal), b'{"vehicle": 1, ' + text.encode(), text.encode()):
        said = over(verbs.resume, {"status": own, "command": answer})
        assert said.count("\n") == 1
        assert len(said) < 5000


@QUICK
@given(WORDS, HEARD, HEARD, st.none() | st.integers(-9, 9) | st.floats() | HEARD, st.integers(0, 255))
@example("[/red]", "[/x]", "[bold", "[/b]", 0)
@example("", ":WARNING:", ":warning:", None, 3)
def test_preflight_shows_rows_as_they_are_and_none_as_another_vehicles(
    word: str, text: str, limit: str, value: Any, vehicle: int
) -> None:
    row = Check(text, value, limit, False, text, vehicle=vehicle)
    told = account(1, configuration=word, assignment=word, checks=(row,) * 3)
    said = over(verbs.preflight, {"preflight": encode(told)}, explain=True)
    assert said.rstrip().split("\n")[-1].startswith("not fit for take-off")
    faults = [line for line in said.split("\n") if line.startswith(("vehicle 1: ", "vehicle 2: "))]
    assert faults
    if text == one_line(text) and text:
        assert f"vehicle 1: {text}" in faults
        assert f"vehicle 2: {text}" in faults
    with pytest.raises(verbs.RefusedError) as refused:
        over(verbs.takeoff, {"preflight": encode(told), "status": encode(status())})
    shown(lambda: tell(str(refused.value)))


@QUICK
@given(HEARD, WORDS)
def test_the_view_of_a_flight_shows_no_control_characters(text: str, word: str) -> None:
    vehicles: dict[int, Status | None] = {1: status(phase=word, failsafes=[text], killed=text or None), 2: None}
    progress = Progress(1.0, "flying", vehicles, {2: -9}, {1: text})

    def show() -> None:
        with FlightView(quiet=False) as view:
            view.show_progress(progress)

    said = shown(show)
    assert "flying" in said
    assert one_line(text) in said


@pytest.mark.parametrize("said", WORST[:-1])
def test_the_live_view_shows_no_control_characters_of_others(said: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TERM", "dumb")
    monkeypatch.setenv("FORCE_COLOR", "1")
    vehicles: dict[int, Status | None] = {1: status(phase=said[:64], failsafes=[said], killed=said), 2: None}
    err = io.StringIO()
    with redirect_stderr(err), FlightView(quiet=False) as view:
        view.show_progress(Progress(1.0, "flying", vehicles, {2: -9}, {1: said}))
    ours = re.compile(r"\x1b\[[0-9;]*m|\x1b\[\?25[hl]|\x1b\[[0-9]*[A-H]|\x1b\[2K|\r")
    assert all(c.isprintable() or c == "\n" for c in ours.sub("", err.getvalue()))


@QUICK
@given(HEARD)
def test_the_summary_shows_no_control_characters(text: str) -> None:
    none = {"p50": None, "p99": None}
    summary: dict[str, Any] = dict.fromkeys(
        (
            "vehicles", "formed_after_s", "shape_formed_after_s", "place_taken_after_s",
            "minimum_distance_m", "cpu_per_tick_ms", "setpoint_gap_max_s",
            "touchdown_max_m_s",
        ),
        text,
    )  # fmt: skip
    estimates = {"formation_error_decorrelated_rms_m": None}
    steady: dict[str, Any] = dict.fromkeys(
        (
            "formation_error_rms_m", "seconds", "velocity_error_rms_m_s", "centroid_error_rms_m",
            "messages_per_vehicle_hz", "reduction_vs_20hz_percent", "payload_bytes_per_vehicle_s",
            "wire_bytes_per_vehicle_s", "packets_per_vehicle_hz", "packets_reduction_vs_20hz_percent", "lambda2_min",
        ),
        1.0,
    )  # fmt: skip
    steady |= {"network": text}
    order = {
        "at_s": 31.4, "verb": "kill", "issuer": text, "id": text, "accepted": [3], "refused": {"1": text},
        "unanswered": [2],
    }  # fmt: skip
    summary |= {
        "steady": steady,
        "estimates": estimates, "latency_ms": none, "loop_lateness_ms": none, "reference_lateness_ms": none,
        "killed": {1: text}, "failsafes": [text], "lost": [1], "unrecorded": {1: text}, "autopilots_lost": {1: text},
        "missing": {1: text}, "rejected": {text: 1}, "folder": text, "commands": [order], "passed": False,
        "judged_by": text, "believed": {**steady, "minimum_distance_m": 1.0},
        "criteria": [{"what": text, "limit": text, "value": text, "met": False}],
    }  # fmt: skip
    said = shown(lambda: show_summary(summary))
    assert said.endswith("not passed\n")
    if len(text) <= 60:
        assert re.sub(r"\s", "", f"not met: {one_line(text)}") in re.sub(r"\s", "", said)


@QUICK
@given(SAID)
def test_a_companions_log_has_a_printable_line_for_each_note(said: str) -> None:
    motion = replace(CONFIG.first_motion, shape=said)
    for note in (said, sentence(MotionAdopted(motion))):
        line = log_line(3, note).decode()
        assert line.startswith("vehicle 3: ")
        assert line[:-1].isprintable()
        assert line.endswith("\n")


def test_what_is_printed_passes_one_door() -> None:
    """JSON has no control characters, and a study shows its own figures."""
    root = Path(__file__).resolve().parents[2]
    ways = re.compile(
        r"typer\.echo\((?!json\.dumps)|sys\.std(out|err)\.write|"
        r"console\.print\((?!fit|Text|table|\"passed|status_table)"
    )
    files = [p for folder in ("companion", "sim") for p in (root / folder).rglob("*.py")]
    files = [p for p in files if p.name != "terminal.py" and p.parent.name != "study"]
    found = [f"{p.name}: {line}" for p in files for line in p.read_text().split("\n") if ways.search(line)]
    assert not found


@pytest.mark.parametrize("module", ["companion", "sim"])
def test_a_terminal_of_another_encoding_ends_no_command(module: str, tmp_path: Path) -> None:
    folder = tmp_path / "飛行\x1b[2J"
    folder.mkdir()
    done = subprocess.run(
        [sys.executable, "-m", module, *(["operator"] if module == "companion" else []), "init", str(folder)],
        capture_output=True, timeout=60, check=False, env={**os.environ, "PYTHONIOENCODING": "ascii:strict"},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert b"\\u98db" in done.stdout
    assert b"\x1b" not in done.stdout
