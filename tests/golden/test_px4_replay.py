"""A flight on a real PX4 v1.16, replayed without one: the same inputs give the same outputs, byte for byte.

Whoever changes what the agent says on purpose records it anew, in the repository's folder:

    rm -rf flights/golden && fleet up --fleet tests/golden/px4_flight.toml --autopilot px4 --px4 "$PX4_BUILD" \
        --out flights/golden && cp flights/golden/*/vehicle-1.mcap tests/golden/px4_flight.mcap
"""

from collections import Counter
from pathlib import Path

from companion.io.recording import read_recording
from companion.io.replay import replay_file

RECORDING = Path(__file__).parent / "px4_flight.mcap"
SIZE_MAX = 2_000_000


def test_the_recorded_flight_gives_the_same_outputs_byte_for_byte() -> None:
    result = replay_file(RECORDING)
    assert result.same, result.sentence()
    assert result.outputs > 500


def test_the_recording_is_a_whole_flight_and_small() -> None:
    assert RECORDING.stat().st_size <= SIZE_MAX
    recording = read_recording(RECORDING)
    assert recording.complete
    assert recording.missing() == 0
    notes = [e.body.decode().split(":")[0] for e in recording.entries if e.channel == "note"]
    flown = [n for n in notes if " -> " in n]
    assert flown == [
        "idle -> preflight", "preflight -> armed", "armed -> climbing", "climbing -> waiting", "waiting -> forming",
        "forming -> formed", "formed -> moving", "moving -> landing", "landing -> landed",
    ]  # fmt: skip
    assert "failsafe" not in notes
    channels = Counter(e.channel for e in recording.entries)
    assert channels["input/peer"] > 0
