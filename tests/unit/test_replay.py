"""What a replay notices at a recording's end."""

from pathlib import Path

from companion.config import load
from companion.core.values import Instant
from companion.io.recording import Entry
from companion.io.replay import replay
from companion.vehicle.agent import Agent

CONFIG = load(Path(__file__).resolve().parents[2] / "fleet.toml")
START = Instant(0, 1_700_000_000_000_000_000)


def test_outputs_missing_at_the_end_are_a_difference_unless_the_recording_was_cut_off() -> None:
    heartbeat = Agent(CONFIG, 3, 7).advance(START).mavlink
    assert len(heartbeat) == 1
    advance = Entry("advance", START, b"")
    assert replay(Agent(CONFIG, 3, 7), [advance, Entry("output/mavlink", START, heartbeat[0])]).same
    lacking = replay(Agent(CONFIG, 3, 7), [advance])
    assert not lacking.same
    assert "at the end: replayed output/mavlink" in lacking.sentence()
    assert replay(Agent(CONFIG, 3, 7), [advance], complete=False).same
