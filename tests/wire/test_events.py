"""Events of a flight as bytes."""

import json
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.config import load
from companion.core.events import Event, FailsafeActed, KillCause, Killed, MotionAdopted, PhaseChanged
from companion.core.failsafe import Failsafe
from companion.core.values import Phase
from companion.errors import WireError
from companion.wire.events import decode_event, encode_event

FLEET = Path(__file__).resolve().parents[2] / "fleet.toml"
PHASES = st.sampled_from(Phase)
EVENTS = st.one_of(
    st.builds(PhaseChanged, PHASES, PHASES),
    st.builds(FailsafeActed, st.sampled_from(Failsafe), st.text()),
    st.builds(Killed, st.sampled_from(KillCause)),
    st.just(MotionAdopted(load(FLEET).first_motion)),
)
JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.text(max_size=9),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from(("kind", "motion", "cause")), inner),
)  # fmt: skip


@given(EVENTS)
def test_an_event_returns_as_it_was(event: Event) -> None:
    assert decode_event(encode_event(event)) == event


@given(st.binary(max_size=60) | JSON.map(lambda said: json.dumps(said).encode()) | EVENTS.map(encode_event))
def test_whatever_comes_is_an_event_or_a_wire_error(payload: bytes) -> None:
    try:
        event = decode_event(payload)
    except WireError:
        return
    assert decode_event(encode_event(event)) == event


@pytest.mark.parametrize(
    "payload",
    [b"[" * 60_000, b"\xff", b'{"kind": "phase", "before": "x", "after": "formed"}', b'{"kind": "killed", "cause": 3}'],
)
def test_what_is_no_event_is_refused(payload: bytes) -> None:
    with pytest.raises(WireError):
        decode_event(payload)
