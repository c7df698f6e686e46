"""Events of a flight as bytes."""

import json
from pathlib import Path
from typing import get_args

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.config import load
from companion.core.events import Event, MotionAdopted, sentence
from companion.errors import WireError
from companion.wire.events import KINDS, decode_event, encode_event

FLEET = Path(__file__).resolve().parents[2] / "fleet.toml"
EVENTS = st.one_of(
    st.just(MotionAdopted(load(FLEET).first_motion)),
    *(st.builds(kind) for kind in KINDS.values() if kind is not MotionAdopted),
)
JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.text(max_size=9),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from(("kind", "motion", "cause")), inner),
)  # fmt: skip


@given(EVENTS)
def test_an_event_returns_as_it_was(event: Event) -> None:
    assert decode_event(encode_event(event)) == event


@given(EVENTS)
def test_every_event_has_a_sentence(event: Event) -> None:
    assert sentence(event)


def test_every_kind_of_event_has_its_name() -> None:
    assert set(KINDS.values()) == set(get_args(Event))


@given(st.binary(max_size=60) | JSON.map(lambda said: json.dumps(said).encode()) | EVENTS.map(encode_event))
def test_whatever_comes_is_an_event_or_a_wire_error(payload: bytes) -> None:
    try:
        event = decode_event(payload)
    except WireError:
        return
    assert decode_event(encode_event(event)) == event


@pytest.mark.parametrize(
    "payload",
    [
        b"[" * 60_000,
        b"\xff",
        b'{"kind": "phase", "before": "x", "after": "formed", "why": "land"}',
        b"[]",
        b"{}",
        b'{"kind": "killed", "cause": 3}',
        b'{"kind": []}',
        b'{"kind": "request refused", "request": "x", "result": 1.5}',
    ],
)
def test_what_is_no_event_is_refused(payload: bytes) -> None:
    with pytest.raises(WireError):
        decode_event(payload)
