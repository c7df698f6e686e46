"""What signing a link costs a companion: the frames of a recorded second, both ways, bare and signed, in turns.

    python -m tests.bench.signing

The golden flight's datagrams to and from its PX4 pass a link with nothing behind it, once as they are and once signed
by both ends. What is told is the CPU of a 50 Hz tick's share, the medians of rounds that take turns, and the ratio to a
whole tick as `fleet up --json` tells it (`--tick-ms`, cpu_per_tick_ms).
"""

import statistics
import time
from pathlib import Path
from tempfile import TemporaryDirectory

import typer

from companion.io.link import Address
from companion.io.recording import read_recording
from companion.io.signed_link import SignedLink
from companion.io.signing_key import make_key, read_key
from companion.wire.mavlink import READ, MavlinkCodec
from companion.wire.signing import SigningClock, extras_of, signed

RECORDING = Path(__file__).resolve().parents[1] / "golden" / "px4_flight.mcap"
ROUNDS = 15
TICKS_PER_S = 50
AUTOPILOT: Address = ("127.0.0.1", 14580)


class Nothing:
    """A bare link that hands out what it was given and drops what is sent."""

    foreign_datagrams = send_failures = 0
    fault = ""

    def __init__(self) -> None:
        self.refused: dict[str, int] = {}
        self.waiting: list[bytes] = []

    def fileno(self) -> int:
        return 0

    def receive(self) -> list[tuple[bytes, int, Address]]:
        taken, self.waiting = self.waiting, []
        return [(datagram, 0, AUTOPILOT) for datagram in taken]

    def admits(self, address: Address, received_ns: int) -> bool:
        return True

    def confirm(self, address: Address, received_ns: int) -> None:
        pass

    def send(self, datagram: bytes) -> None:
        pass

    def close(self) -> None:
        pass


def spent_s(link: Nothing | SignedLink, bare: Nothing, heard: list[bytes], said: list[bytes]) -> float:
    """CPU of all these frames: heard and decoded, said."""
    codec = MavlinkCodec(1)
    begin = time.thread_time()
    for datagram in heard:
        bare.waiting.append(datagram)
        for frame, _, _ in link.receive():
            codec.decode(frame)
    for datagram in said:
        link.send(datagram)
    return time.thread_time() - begin


def main(tick_ms: float = typer.Option(0.6, help="CPU of a whole tick, as cpu_per_tick_ms of a summary.")) -> None:
    """Print both, and the ratios."""
    entries = list(read_recording(RECORDING).entries)
    seconds = (entries[-1].instant.monotonic_ns - entries[0].instant.monotonic_ns) * 1e-9
    heard = [e.body for e in entries if e.channel == "input/mavlink"]
    said = [e.body for e in entries if e.channel == "output/mavlink"]
    with TemporaryDirectory() as folder:
        file = Path(folder) / "one.key"
        make_key(file)
        key, extras = read_key(file), extras_of(*READ)
        bare, signed_s = [], []
        for _ in range(ROUNDS):
            nothing = Nothing()
            bare.append(spent_s(nothing, nothing, heard, said))
            nothing, clock = Nothing(), SigningClock(time.time_ns)
            theirs = [
                signed(key, frame, extras[frame[7:10]], 0, clock.next()) if frame[7:10] in extras else frame
                for frame in heard
            ]
            signed_s.append(spent_s(SignedLink(nothing, file), nothing, theirs, said))
    ticks = seconds * TICKS_PER_S
    plain_us, with_us = (statistics.median(x) / ticks * 1e6 for x in (bare, signed_s))
    typer.echo(f"{len(heard) / seconds:.0f} frames heard and {len(said) / seconds:.0f} said a second, {ROUNDS} rounds")
    typer.echo(f"bare   {plain_us:7.1f} us a tick")
    typer.echo(f"signed {with_us:7.1f} us a tick: {with_us - plain_us:.1f} us more")
    typer.echo(f"of a tick of {tick_ms:g} ms: {1.0 + (with_us - plain_us) / (tick_ms * 1000.0):.3f} times the unsigned")


if __name__ == "__main__":
    typer.run(main)
