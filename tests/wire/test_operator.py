"""The operator's protocol: what is written is read again, and nothing else is."""

import json
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.errors import WireError
from companion.wire.operator import (
    ANSWER_BYTES_MAX,
    COMMAND_BYTES_MAX,
    COMMAND_FAULTS,
    ENDING,
    PLACES_MAX,
    VERBS,
    Answer,
    ClockReading,
    Command,
    Place,
    Scare,
    as_json,
    decode,
    decode_command,
    encode,
)

COMMAND = Command(verb="land", id="9f2c", issuer="operator-1b", after={1: (Place(7, 1, 4),), 2: ()})
SCARE = Scare(begins_ns=5, north_m=-40.0, east_m=2.5, north_m_s=6.0, east_m_s=0.0, radius_m=10.0, lasts_s=15.0)
ANSWER = Answer(vehicle=3, accepted=False, reason="it is on the ground", place=Place(7, 1, 4), revision=2)
places = st.builds(Place, *[st.integers(0, 2**63 - 1)] * 3)
names = st.text(st.characters(exclude_categories=("Cs",)), min_size=1, max_size=64)


@given(
    st.sampled_from(VERBS), names, names,
    st.dictionaries(st.integers(1, 250), st.lists(places, max_size=PLACES_MAX).map(tuple), max_size=5), st.booleans(),
)  # fmt: skip
def test_a_command_survives_its_journey(verb: Any, own_id: str, issuer: str, after: Any, confirm: bool) -> None:
    command = Command(verb=verb, id=own_id, issuer=issuer, after=after, confirm=confirm)
    assert decode_command(encode(command)) == command


def test_what_is_fled_survives_its_journey() -> None:
    command = replace(COMMAND, verb="scare", threat=SCARE)
    assert decode_command(encode(command)) == command


def test_a_command_carries_what_its_verb_needs_and_no_more() -> None:
    assert set(as_json(COMMAND)) == {"verb", "id", "issuer", "after"}
    assert set(as_json(replace(COMMAND, verb="kill", confirm=True))) == {"verb", "id", "issuer", "after", "confirm"}


def test_an_answer_and_a_clock_reading_survive_their_journey() -> None:
    assert decode(Answer, encode(ANSWER)) == ANSWER
    reading = ClockReading(boot_id=1, received_ns=5, answered_ns=7)
    assert decode(ClockReading, encode(reading)) == reading


def test_what_ends_a_flight_are_verbs() -> None:
    assert set(VERBS) >= ENDING


def changed(**fields: object) -> bytes:
    plain = {"verb": "land", "id": "9f2c", "issuer": "me", "after": {"1": [[7, 1, 4]]}, **fields}
    return json.dumps({k: v for k, v in plain.items() if v != "left out"}).encode()


def threat(**fields: object) -> bytes:
    return changed(verb="scare", threat={**as_json(replace(COMMAND, threat=SCARE))["threat"], **fields})


WRONG: list[tuple[bytes, str, str]] = [
    (b"", "malformed", "needs a JSON object with a verb"),
    (b"[]", "malformed", "needs a JSON object with a verb"),
    (b"[" * 60_000, "malformed", "needs a JSON object with a verb"),
    (changed(verb="left out"), "malformed", "needs a JSON object with a verb"),
    (
        changed(verb="fly"), "unknown verb",
        "unknown verb 'fly'; known: takeoff, land, motion, wish, scare, release, resume, kill",
    ),
    (changed(verb=3), "unknown verb", "unknown verb 3;"),
    (changed(id=""), "id", "id must be a text of up to 64 characters, got ''"),
    (changed(id="left out"), "id", "got nothing"),
    (changed(issuer="x" * 65), "issuer", "issuer must be a text of up to 64 characters"),
    (changed(issuer=None), "issuer", "got None"),
    (changed(after="left out"), "places", "after must be an object of vehicle ids"),
    (changed(after=[]), "places", "got []"),
    (changed(after={"1": [[7, 1]]}), "places", "[boot id, flights begun, commands obeyed]"),
    (changed(after={"1": [[7, 1, True]]}), "places", "got True"),
    (changed(after={"1": [[7, 1, -1]]}), "places", "got -1"),
    (changed(after={"1": [[7, 1, 2**63]]}), "places", "got 9223372036854775808"),
    (changed(after={"251": []}), "places", "after must be"),
    (changed(after={"1": [[7, 1, 4]] * (PLACES_MAX + 1)}), "places", f"with up to {PLACES_MAX} of"),
    (changed(confirm=1), "malformed", "confirm must be true or false, got 1"),
    (threat(radius_m=0.99), "malformed", "threat.radius_m must be 1 to 50 m, got 0.99"),
    (threat(radius_m=50.01), "malformed", "threat.radius_m must be 1 to 50 m, got 50.01"),
    (threat(lasts_s=0.0), "malformed", "threat.lasts_s must be 0.5 to 60 s, got 0.0"),
    (threat(lasts_s=61.0), "malformed", "threat.lasts_s must be 0.5 to 60 s, got 61.0"),
    (threat(north_m=1.1e4), "malformed", "threat.north_m must be within 10000 m of the fleet origin, got 11000.0"),
    (threat(east_m_s=-31.0), "malformed", "threat.east_m_s must be within 30 m/s, got -31.0"),
    (threat(north_m_s=float("nan")), "malformed", "threat.north_m_s must be within 30 m/s, got nan"),
    (threat(east_m="2"), "malformed", "threat.east_m must be within 10000 m"),
    (threat(begins_ns=-1), "malformed", "threat.begins_ns must be a fleet time in ns, got -1"),
    (changed(threat=3), "malformed", "threat must be an object with begins_ns, north_m"),
    (changed(motion=" " * COMMAND_BYTES_MAX), "malformed", f"may have {COMMAND_BYTES_MAX}"),
]  # fmt: skip


@pytest.mark.parametrize(("payload", "kind", "sentence"), WRONG)
def test_a_command_of_another_form_is_refused_by_kind_and_with_what_is_allowed(
    payload: bytes, kind: str, sentence: str
) -> None:
    with pytest.raises(WireError) as refused:
        decode_command(payload)
    assert refused.value.kind == kind
    assert sentence in refused.value.detail
    assert len(refused.value.detail) < 200


def test_every_kind_of_fault_is_shown() -> None:
    assert {kind for _, kind, _ in WRONG} == set(COMMAND_FAULTS)


@given(st.binary(max_size=80) | st.text(max_size=40).map(str.encode))
def test_no_bytes_raise_anything_else(payload: bytes) -> None:
    with pytest.raises(WireError):
        decode_command(payload)
    with pytest.raises(WireError):
        decode(Answer, payload)


@pytest.mark.parametrize("field", ["vehicle", "accepted", "reason", "place", "revision", "in_order"])
@pytest.mark.parametrize("value", ["x" * 5, -1, [], {}, 2.5])
def test_an_answer_with_a_value_of_another_kind_names_its_place(field: str, value: object) -> None:
    if field == "reason" and isinstance(value, str):
        return
    with pytest.raises(WireError, match=rf"answer: {field}"):
        decode(Answer, json.dumps({**as_json(ANSWER), field: value}).encode())


def test_a_newer_companion_may_tell_more() -> None:
    assert decode(Answer, json.dumps({**as_json(ANSWER), "weather": "fair"}).encode()) == ANSWER


def test_an_answer_is_no_longer_than_any_true_one() -> None:
    with pytest.raises(WireError, match="may have"):
        decode(Answer, encode(replace(ANSWER, reason="x" * ANSWER_BYTES_MAX)))
