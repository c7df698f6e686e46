"""Which PX4 an autopilot is: by what it tells of itself, and by the parameters that it has."""

from itertools import pairwise
from pathlib import Path
from typing import get_args

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import development as dialect

from companion.config.schema import StubTable
from companion.errors import ConfigError
from companion.vehicle.autopilot.px4_identity import RETRY_NS, TRIES, VERIFIED, Px4Identity
from companion.vehicle.autopilot.px4_parameters import PARAMETERS
from companion.vehicle.autopilot.px4_versions import (
    NEWEST,
    OLDEST,
    STICKS,
    VERSIONS,
    same_setting,
    version_named,
    version_of,
)
from companion.wire.mavlink import MavlinkCodec
from companion.wire.px4 import Software

OLD, NEW = STICKS
DOCS = Path(__file__).resolve().parents[2] / "docs" / "px4.md"


def software(major: int, minor: int, patch: int = 0, kind: int = 255, git: str = "") -> Software:
    return Software(major, minor, patch, kind, git)


def test_rows_are_in_order_and_each_has_a_name_of_its_own() -> None:
    assert all(a.number < b.number for a, b in pairwise(VERSIONS))
    assert len({v.name for v in VERSIONS}) == len(VERSIONS)
    assert all(version_named(v.name) is v for v in VERSIONS)
    assert get_args(StubTable.model_fields["px4"].annotation) == tuple(v.name for v in VERSIONS)
    with pytest.raises(ConfigError, match=r"must be one of 1\.16, .*got '1\.15'"):
        version_named("1.15")


def test_both_names_of_the_pilots_setting_are_read() -> None:
    assert set(STICKS) <= set(PARAMETERS)
    assert same_setting(OLD) == same_setting(NEW) == STICKS
    assert same_setting("GF_ACTION") == ("GF_ACTION",)


@pytest.mark.parametrize(
    ("told", "there", "name"),
    [
        (software(1, 16), {OLD}, "1.16"),
        (software(1, 16, 9), {OLD}, "1.16"),
        (software(1, 17), {OLD}, "1.17"),
        (software(1, 18), {NEW}, "1.18"),
        (software(1, 19), {NEW}, "main"),
        (software(1, 20), {NEW}, "main"),
        (software(2, 0), {NEW}, "main"),
        (software(1, 18), {OLD}, "1.17"),  # a branch before the change, tagged after it
        (software(1, 16), {NEW}, "1.18"),  # a fork of main that kept an old tag
        (software(0, 0), {OLD}, "1.17"),
        (software(0, 0), {NEW}, "main"),
        (None, {OLD}, "1.17"),
        (None, {NEW}, "main"),
        (None, set(), "main"),
        (software(1, 16), set(), "1.16"),
    ],
)
def test_the_row_is_by_number_and_the_parameters_have_the_last_word(
    told: Software | None, there: set[str], name: str
) -> None:
    assert version_of(told, there).name == name


@given(
    st.one_of(st.none(), st.builds(software, st.integers(0, 255), st.integers(0, 255))),
    st.sets(st.sampled_from(STICKS)),
)
def test_whatever_it_tells_the_row_has_a_name_that_answers(told: Software | None, there: set[str]) -> None:
    row = version_of(told, there)
    assert not there or row.sticks in there


def identified(told: Software | None, *there: str) -> tuple[bool, bool, str]:
    identity = Px4Identity()
    if told is not None:
        identity.take(told)
    for k in range(TRIES):
        identity.ask(k * RETRY_NS)
    check = identity.check(there)
    return check.passed, check.warns, check.message


@pytest.mark.parametrize("row", VERSIONS, ids=lambda v: v.name)
def test_a_version_of_the_table_is_flown_without_a_word(row: object) -> None:
    assert row in VERSIONS
    known = version_of(None, ()) if row is None else row
    assert identified(software(*known.number), known.sticks) == (True, False, "")  # type: ignore[attr-defined]


def test_one_that_is_older_than_all_is_refused_and_says_why() -> None:
    passed, _, says = identified(software(OLDEST.number[0], OLDEST.number[1] - 1, 4), OLD)
    assert not passed
    assert says == ("PX4 is v1.15.4, must be v1.16 or newer: older ones do not tell a failsafe of their own in flight")


def test_a_newer_one_is_flown_with_a_warning_that_names_what_was_verified() -> None:
    passed, warns, says = identified(software(NEWEST.number[0], NEWEST.number[1] + 1, 0, 64, "0123456789"), NEW)
    assert (passed, warns) == (True, True)
    assert says.startswith(f"PX4 v1.20.0-alpha (0123456789) is newer than any that was verified ({VERIFIED})")


@pytest.mark.parametrize(
    ("told", "there", "says"),
    [
        (None, NEW, "PX4 does not tell its version: it is taken for v1.19, "),
        (software(0, 0, 0, 0), OLD, "PX4 tells v0.0.0-dev, as a build without tags does: it is taken for v1.17, "),
        (software(1, 16), NEW, "PX4 tells v1.16.0 and has MAN_OVERRIDE_SPD, as v1.18 and newer have: "),
        (software(1, 19), OLD, "PX4 tells v1.19.0 and has COM_RC_OVERRIDE, as v1.17 and older have: "),
    ],
)
def test_what_contradicts_itself_or_is_silent_is_flown_with_a_word(
    told: Software | None, there: str, says: str
) -> None:
    passed, warns, said = identified(told, there)
    assert (passed, warns) == (True, True)
    assert said.startswith(says)


def test_nobody_takes_off_before_it_has_told_or_was_asked_in_vain() -> None:
    identity = Px4Identity()
    assert identity.check({NEW}).message == "PX4's version is not told yet"
    assert not identity.check({NEW}).passed
    assert not identity.check({NEW}).permanent
    identity.take(software(1, 18))
    assert identity.check({NEW}).passed


def test_it_is_asked_once_a_second_until_it_tells_and_no_more_than_so_often() -> None:
    identity = Px4Identity()
    asked = [ns for ns in range(0, 30 * RETRY_NS, RETRY_NS // 10) if identity.ask(ns)]
    assert asked == [k * RETRY_NS for k in range(TRIES)]
    assert identity.deadline_ns() > 1000 * RETRY_NS
    identity.restart()
    assert identity.ask(0)
    assert identity.deadline_ns() == RETRY_NS
    assert identity.take(software(1, 18))
    assert not identity.take(software(1, 18)), "the same again is no news"
    assert not identity.ask(10 * RETRY_NS)


def test_autopilot_version_is_read_as_px4_writes_it() -> None:
    codec = MavlinkCodec(7)
    sender = dialect.MAVLink(None, srcSystem=7, srcComponent=1)
    git = int("bb59c637cd012345", 16).to_bytes(8, "little")
    message = dialect.MAVLink_autopilot_version_message(
        1 << 63, 1 << 24 | 19 << 16 | 2 << 8 | 64, 1, 2, 3, list(git), [1] * 8, [2] * 8, 4, 5, 6, [7] * 18
    )
    (told,) = codec.decode(bytes(message.pack(sender)))
    assert told == Software(1, 19, 2, 64, "bb59c637cd")
    assert str(told) == "1.19.2-alpha (bb59c637cd)"


def test_the_docs_have_a_column_for_each_version() -> None:
    text = DOCS.read_text(encoding="utf-8")
    assert all(f"v{'.'.join(map(str, v.number))}" in text for v in VERSIONS)
