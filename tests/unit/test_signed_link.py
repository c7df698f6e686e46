"""The companion's end of a signed link: whom it believes, what it counts, by which time it signs across restarts."""

import os
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import development as dialect

from companion.errors import CompanionError, ConfigError
from companion.io.link import Address
from companion.io.signed_link import BELIEVED_S, SignedLink
from companion.io.signing_key import RESERVE_S, SignedTime, make_key, read_key
from companion.wire.mavlink import HEARTBEAT, LOCAL_POSITION_NED, SYS_STATUS, MavlinkCodec
from companion.wire.mavlink_frames import Layout
from companion.wire.signing import TICKS_PER_S, Refused, signed, ticks_at

PX4: Address = ("127.0.0.1", 14580)
NOW_NS = 1_790_000_000_000_000_000
NOW = ticks_at(NOW_NS)
OTHER = bytes(range(32))
UNREAD = Layout(30, bytes((39,)), LOCAL_POSITION_NED.fields)


class Wire:
    """A bare link by hand."""

    def __init__(self) -> None:
        self.waiting: list[bytes] = []
        self.sent: list[bytes] = []
        self.foreign_datagrams = self.send_failures = 0
        self.refused: dict[str, int] = {}
        self.fault = ""
        self.closed = False

    def fileno(self) -> int:
        return 0

    def receive(self) -> list[tuple[bytes, int, Address]]:
        taken, self.waiting = self.waiting, []
        return [(datagram, 1, PX4) for datagram in taken]

    def admits(self, address: Address, received_ns: int) -> bool:
        return True

    def confirm(self, address: Address, received_ns: int) -> None:
        pass

    def send(self, datagram: bytes) -> None:
        self.sent.append(datagram)

    def close(self) -> None:
        self.closed = True


class End:
    """A companion's end with clocks by hand, and PX4's frames to it."""

    def __init__(self, folder: Path, wall_ns: int = NOW_NS) -> None:
        self.file = folder / "vehicle.key"
        if not self.file.exists():
            make_key(self.file)
        self.key = read_key(self.file)
        self.wall_ns, self.monotonic_ns = wall_ns, 0
        self.wire = Wire()
        self.link = SignedLink(self.wire, self.file, lambda: self.wall_ns, lambda: self.monotonic_ns)

    def hear(self, *datagrams: bytes) -> list[bytes]:
        self.wire.waiting += datagrams
        return [frame for frame, _, _ in self.link.receive()]

    def sent_ticks(self) -> int:
        self.link.send(MavlinkCodec(1).heartbeat())
        return int.from_bytes(self.wire.sent[-1][-12:-6], "little")


def plain(layout: Layout = LOCAL_POSITION_NED) -> bytes:
    return layout.pack((0,) * len(layout.fields.unpack(bytes(layout.fields.size))), 0, 1, 1)


def by(key: bytes, ticks: int, layout: Layout = LOCAL_POSITION_NED) -> bytes:
    return signed(key, plain(layout), layout.extra, 0, ticks)


def test_what_is_signed_reaches_the_agent_as_it_came_and_the_rest_is_counted_by_reason(tmp_path: Path) -> None:
    end = End(tmp_path)
    good = by(end.key, NOW)
    assert end.hear(good) == [good]
    assert end.hear(good, plain(), by(OTHER, NOW + 1), by(end.key, NOW + 61 * TICKS_PER_S)) == []
    counted = {why: n for why, n in end.link.refused.items() if n}
    assert counted == {Refused.REPLAYED: 1, Refused.UNSIGNED: 1, Refused.WRONG_SIGNATURE: 1, Refused.AHEAD: 1}
    later = by(end.key, NOW + 1)
    assert end.hear(later) == [later], "nothing was learned from the forged ones"


def test_several_frames_of_one_datagram_are_judged_one_by_one(tmp_path: Path) -> None:
    end = End(tmp_path)
    first, last = by(end.key, NOW), by(end.key, NOW + 1, SYS_STATUS)
    assert end.hear(first + plain() + last) == [first, last]


def test_what_nobody_reads_costs_no_digest_and_is_no_impostor(tmp_path: Path) -> None:
    end = End(tmp_path)
    assert end.hear(plain(UNREAD), by(OTHER, NOW, UNREAD)) == []
    assert not any(end.link.refused.values())


def test_an_autopilot_that_has_booted_is_found_by_its_heartbeat_and_must_sign_from_then_on(tmp_path: Path) -> None:
    end = End(tmp_path)
    long_ago = by(end.key, NOW - 1000 * TICKS_PER_S, HEARTBEAT)
    unsigned = plain(HEARTBEAT)
    assert end.hear(unsigned, long_ago) == [unsigned, long_ago]
    assert end.hear(by(end.key, NOW - 999 * TICKS_PER_S)) == [], "a position must be of now"
    good = by(end.key, NOW)
    assert end.hear(good) == [good]
    assert end.hear(unsigned) == [], "an impostor's: the autopilot signs"
    end.monotonic_ns = round(BELIEVED_S * 1e9) + 1
    assert end.hear(unsigned) == [unsigned], "it may have booted anew"


def test_a_heartbeat_of_mavlink_1_is_believed_from_nobody(tmp_path: Path) -> None:
    end = End(tmp_path)
    mav = dialect.MAVLink(None, srcSystem=1, srcComponent=1)
    old = bytes(dialect.MAVLink_heartbeat_message(2, 12, 0, 0, 3, 3).pack(mav, force_mavlink1=True))
    assert end.hear(old) == []
    assert end.link.refused[Refused.UNSIGNED] == 1


def test_what_is_sent_is_signed_by_wall_time_and_read_by_pymavlink(tmp_path: Path) -> None:
    end = End(tmp_path)
    begin = end.sent_ticks()
    end.wall_ns += 3600 * 1_000_000_000
    assert end.sent_ticks() >= begin + 3500 * TICKS_PER_S, "the clock follows wall time"
    reader = dialect.MAVLink(None)
    reader.signing.secret_key = end.key
    assert reader.parse_buffer(bytearray(end.wire.sent[-1]))[0].get_type() == "HEARTBEAT"


@pytest.mark.parametrize("killed", [True, False])
@pytest.mark.parametrize("back_s", [0, 10, 10**8])
def test_after_a_restart_nothing_is_signed_by_a_time_that_was_used(tmp_path: Path, killed: bool, back_s: int) -> None:
    end = End(tmp_path)
    for _ in range(200):
        end.wall_ns += 1_000_000_000
        end.monotonic_ns += 1_000_000_000
        end.hear(by(end.key, ticks_at(end.wall_ns)))
        last = end.sent_ticks()
    if not killed:
        end.link.close()
        assert end.wire.closed
    again = End(tmp_path, wall_ns=max(end.wall_ns - back_s * 1_000_000_000, 0))
    assert last < again.sent_ticks() <= last + (RESERVE_S + 1) * TICKS_PER_S


def test_a_disk_that_takes_nothing_ends_no_flight_and_is_told_once(tmp_path: Path) -> None:
    folder = tmp_path / "ro"
    folder.mkdir()
    make_key(folder / "vehicle.key")
    (folder / "vehicle.key.time").mkdir()  # cannot be replaced by a file
    end = End(folder)
    assert end.sent_ticks() >= NOW
    assert "vehicle.key.time" in end.link.fault


def test_nonsense_in_the_file_of_the_time_is_no_time(tmp_path: Path) -> None:
    (tmp_path / "a.key.time").write_text("yesterday")
    assert SignedTime(tmp_path / "a.key").not_before == 0


@pytest.mark.parametrize(
    ("text", "mode", "why"),
    [
        (None, 0o600, r"cannot be read \(No such file or directory\); `companion signing make"),
        ("00" * 31, 0o600, "must be 64 hexadecimal digits, got 62 characters"),
        ("zz" * 32, 0o600, "must be 64 hexadecimal digits, got 64 characters"),
        ("00" * 32, 0o600, "is all zeros, which means no key"),
        ("ab" * 32, 0o640, r"may be read or written by others \(mode 640\), must be 600: `chmod 600"),
        ("ab" * 32, 0o604, "may be read or written by others"),
    ],
)
def test_a_key_that_is_none_is_refused_with_what_would_be_right(
    tmp_path: Path, text: str | None, mode: int, why: str
) -> None:
    file = tmp_path / "vehicle.key"
    if text is not None:
        file.write_text(text)
        file.chmod(mode)
    with pytest.raises(ConfigError, match=why):
        read_key(file)


def test_a_key_that_is_there_is_not_overwritten_and_a_new_one_is_for_its_owner_alone(tmp_path: Path) -> None:
    file = tmp_path / "vehicle.key"
    make_key(file)
    key = read_key(file)
    assert os.stat(file).st_mode & 0o777 == 0o600
    with pytest.raises(CompanionError, match="is there already"):
        make_key(file)
    assert read_key(file) == key
    make_key(tmp_path / "other.key")
    assert read_key(tmp_path / "other.key") != key
