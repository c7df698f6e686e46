"""A link on which every frame is signed: between the loop and the bare link, so that the agent knows of no keys.

What is heard reaches the agent as it came, signature and all, if it is believed; what the agent sends is recorded
before it is signed. So recordings hold no secret, and a replay needs none.

HEARTBEAT is taken unsigned, or with a time stamp of long ago, while nothing has been believed of late: a PX4 that has
booted signs by the time of its key until it hears ours. Once its stream is believed, a HEARTBEAT must be signed too.
"""

import time
from collections.abc import Callable
from pathlib import Path

from companion.config.derived import Vehicle
from companion.core.counts import Counts
from companion.io.link import Address, Link, open_bare_link
from companion.io.signing_key import SignedTime, read_key
from companion.wire.mavlink import READ, SENT
from companion.wire.mavlink_frames import MARK_2, frames_of
from companion.wire.signing import AHEAD_LIMIT_S, Refused, SigningClock, Verifier, extras_of, signed

HEARTBEAT, MAVLINK_1 = b"\0\0\0", b""
"""message ids as they lie in a frame"""
LINK_ID = 1
"""ours; PX4 keeps a time stamp for each"""
BELIEVED_S = 3.0
"""without a believed frame for so long a HEARTBEAT counts unsigned again"""


def open_link(vehicle: Vehicle, key_file: Path | None) -> Link:
    """A vehicle's link, signed where there is a key; CompanionError says why there is none."""
    link = open_bare_link(vehicle)
    if key_file is None:
        return link
    try:
        return SignedLink(link, key_file)
    except BaseException:
        link.close()
        raise


class SignedLink:
    """A `Link` around another one."""

    def __init__(
        self, link: Link, key_file: Path, wall_ns: Callable[[], int] = time.time_ns,
        monotonic_ns: Callable[[], int] = time.monotonic_ns,
    ) -> None:  # fmt: skip
        self._link = link
        self._key = read_key(key_file)
        self._time = SignedTime(key_file)
        self._clock = SigningClock(wall_ns, self._time.not_before)
        self._verifier = Verifier(self._key, self._clock, AHEAD_LIMIT_S)
        self._extras = extras_of(*SENT)
        self._read = frozenset(layout.key for layout in READ)
        self._monotonic_ns = monotonic_ns
        self._believed_ns: int | None = None
        self._kept_ns = monotonic_ns()
        self.refused = Counts(tuple(Refused))
        """frames that were not believed, by reason"""
        self._time.keep(self._clock.now())

    @property
    def foreign_datagrams(self) -> int:
        """Of the bare link."""
        return self._link.foreign_datagrams

    @property
    def send_failures(self) -> int:
        """Of the bare link."""
        return self._link.send_failures

    @property
    def fault(self) -> str:
        """Why the time cannot be kept on disk; empty: it is."""
        return self._time.failed

    def fileno(self) -> int:
        """For select."""
        return self._link.fileno()

    def receive(self) -> list[tuple[bytes, int, Address]]:
        """The frames waiting that are believed, one each."""
        return [
            (frame, received_ns, address)
            for datagram, received_ns, address in self._link.receive()
            for frame in frames_of(datagram)[0]
            if self._admitted(frame)
        ]

    def _admitted(self, frame: bytes) -> bool:
        kind = frame[7:10] if frame[0] == MARK_2 else MAVLINK_1
        if kind is not MAVLINK_1 and kind not in self._read:
            return False  # nobody reads it: it is not worth a digest
        now_ns = self._monotonic_ns()
        why = self._verifier.judge(frame)
        if why is None:
            self._believed_ns = now_ns
            if now_ns - self._kept_ns >= 1_000_000_000:
                self._kept_ns = now_ns
                self._time.keep(self._clock.last)
            return True
        if kind == HEARTBEAT and not self._believes(now_ns):
            return True
        self.refused[why] += 1
        return False

    def _believes(self, now_ns: int) -> bool:
        return self._believed_ns is not None and now_ns - self._believed_ns <= round(BELIEVED_S * 1e9)

    def admits(self, address: Address, received_ns: int) -> bool:
        """Of the bare link."""
        return self._link.admits(address, received_ns)

    def confirm(self, address: Address, received_ns: int) -> None:
        """Of the bare link."""
        self._link.confirm(address, received_ns)

    def send(self, datagram: bytes) -> None:
        """Sign one frame, and send it."""
        self._link.send(signed(self._key, datagram, self._extras[datagram[7:10]], LINK_ID, self._clock.next()))

    def close(self) -> None:
        """Release the bare link, and note the time that was signed by last."""
        self._time.end(self._clock.last)
        self._link.close()
