"""Packets and bytes that a vehicle sends over its radio, and how soon a cut is noticed.

    python -m tests.bench.packets                              # ten vehicles, noticed within 2, 4 and 10 s
    python -m tests.bench.packets --vehicles 30 --notice 4

Each vehicle has a network namespace with an interface of its own on a common bridge; in it runs the companion's own
transport, with the session that the field profile gives it, and puts state messages of the flown size at the flown
rate: each vehicle's next one after 0.8 to 1 of `trigger.t_max_s`, as heartbeats of a fleet in steady flight are. What
is counted is what the interfaces count (/sys/class/net). Beside it stands the same transport with states at 20 Hz, and
the physical limit without multicast: of N vehicles each must say something to each other one in every time T in which a
lost one is to be noticed, (N - 1) / T packets a second, if none is lost.

Then one vehicle's interface is cut; told is when each other one's transport says that it has gone.

Needs root, `ip` and a kernel with bridges and veth; what it makes has names of its own and is removed at the end.
"""

import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from statistics import mean
from typing import Annotated, Any

import typer

from companion.config import FleetConfig
from companion.config.file import parse
from companion.core.frames import Ned
from companion.core.values import PeerMessage, PeerSample, Phase
from companion.io.network import peer_transport
from companion.io.transport import PresenceChange
from companion.vehicle.publisher import HEARTBEAT_JITTER
from companion.wire.peer import encode_state

ROOT = Path(__file__).resolve().parents[2]
TAG = f"sfp{os.getpid() % 10_000}"
PORT = 7447
CONNECT_S = 60.0
SETTLE_S = 3.0
COMPARED_HZ = 20.0
COMPARED_S = 8.0
app = typer.Typer(add_completion=False, help=__doc__)


def tables(vehicles: int, notice_lost_s: float | None) -> dict[str, Any]:
    """A fleet in the field."""
    peers = {"network": "field"} | ({} if notice_lost_s is None else {"notice_lost_s": notice_lost_s})
    named = [{"id": i, "zenoh": f"tcp/10.9.0.{i}:{PORT}"} for i in range(1, vehicles + 1)]
    return {"fleet": {"name": TAG, "frame": "local"}, "peers": peers, "vehicle": named}


def state_message(config: FleetConfig, vehicle_id: int, sequence: int) -> bytes:
    """A state as it is flown: with a full digest."""
    ids = [v.id for v in config.vehicles if v.id != vehicle_id]
    samples = [
        PeerSample(i, time.time_ns(), Ned(1.0 * i, 0.0, -10.0), Ned(1.0, 0.0, 0.0), 2, Phase.MOVING)
        for i in (vehicle_id, *ids[: config.peers.digest])
    ]
    return encode_state(PeerMessage(vehicle_id, sequence, 0, vehicle_id, samples[0], tuple(samples[1:])))


# -- one vehicle, in its namespace -----------------------------------------------------------------------------------


@app.command(hidden=True)
def vehicle(vehicle_id: int, file: Path) -> None:
    """Run one vehicle's transport; a number on standard input is a rate of states (Hz), 0 the flown one."""
    config = parse(json.loads(file.read_text()), file.name)
    woken, random = threading.Event(), Random(vehicle_id)
    rates = [0.0]

    def heed() -> None:
        for line in sys.stdin:
            rates.append(float(line))
            woken.set()
        rates.append(-1.0)
        woken.set()

    transport = peer_transport(config, vehicle_id, woken.set)
    transport.open()
    threading.Thread(target=heed, daemon=True).start()
    present: set[int] = set()
    rate_hz, due_s, sequence = -1.0, time.monotonic(), 0
    try:
        while rates[-1] >= 0.0:
            if rates[-1] != rate_hz:
                rate_hz, due_s = rates[-1], time.monotonic() + random.random() / COMPARED_HZ
            if time.monotonic() >= due_s:
                transport.publish("state", state_message(config, vehicle_id, sequence))
                sequence += 1
                silence_s = config.trigger.t_max_s * (1.0 - HEARTBEAT_JITTER * random.random())
                due_s += 1.0 / rate_hz if rate_hz > 0.0 else silence_s
            woken.wait(max(due_s - time.monotonic(), 0.0))
            woken.clear()
            before = len(present)
            for event in transport.drain():
                if isinstance(event, PresenceChange):
                    (present.add if event.alive else present.discard)(event.vehicle_id)
            if len(present) != before:
                told = {"at_s": time.monotonic(), "present": sorted(present), "counted": transport.sent()}
                print(json.dumps(told), flush=True)  # noqa: T201
    finally:
        transport.close()


# -- namespaces ------------------------------------------------------------------------------------------------------


def ip(*words: object) -> None:
    """Run `ip`."""
    subprocess.run(["ip", *map(str, words)], check=True)


@dataclass
class Rig:
    """The namespaces of a fleet, and the processes in them."""

    vehicles: int
    processes: dict[int, subprocess.Popen[str]] = field(default_factory=dict)
    present: dict[int, list[tuple[float, frozenset[int]]]] = field(default_factory=dict)
    """vehicle -> when it saw whom"""

    def build(self) -> None:
        """A bridge, and an interface on it for each vehicle."""
        ip("netns", "add", f"{TAG}-air")
        ip("-n", f"{TAG}-air", "link", "add", "air", "type", "bridge")
        ip("-n", f"{TAG}-air", "link", "set", "air", "up")
        for i in range(1, self.vehicles + 1):
            own = f"{TAG}-{i}"
            ip("netns", "add", own)
            ip("-n", own, "link", "add", "radio", "type", "veth", "peer", "name", f"v{i}", "netns", f"{TAG}-air")
            quiet = ["ip", "netns", "exec", own, "sh", "-c", "echo 1 > /proc/sys/net/ipv6/conf/radio/disable_ipv6"]
            subprocess.run(quiet, check=True)
            ip("-n", own, "addr", "add", f"10.9.0.{i}/24", "dev", "radio")
            ip("-n", own, "link", "set", "lo", "up")
            ip("-n", own, "link", "set", "radio", "up")
            ip("-n", f"{TAG}-air", "link", "set", f"v{i}", "master", "air")
            ip("-n", f"{TAG}-air", "link", "set", f"v{i}", "up")

    def remove(self) -> None:
        """All of it."""
        for name in ("air", *range(1, self.vehicles + 1)):
            subprocess.run(["ip", "netns", "del", f"{TAG}-{name}"], check=False, stderr=subprocess.DEVNULL)

    @contextmanager
    def flying(self, config: dict[str, Any]) -> Iterator[None]:
        """Every vehicle's process, all of them connected."""
        file = Path(f"/tmp/{TAG}.json")
        file.write_text(json.dumps(config))
        with ExitStack() as opened:
            opened.callback(file.unlink)
            for i in range(1, self.vehicles + 1):
                self.present[i] = []
                command = ["ip", "netns", "exec", f"{TAG}-{i}", sys.executable, "-m", "tests.bench.packets"]
                process = subprocess.Popen(
                    [*command, "vehicle", str(i), str(file)], cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                    text=True,
                )  # fmt: skip
                opened.enter_context(process)
                opened.callback(process.kill)
                self.processes[i] = process
                threading.Thread(target=self._read, args=(i, process), daemon=True).start()
            everybody = frozenset(range(1, self.vehicles + 1))
            deadline_s = time.monotonic() + CONNECT_S
            while any(not seen or seen[-1][1] != everybody - {i} for i, seen in self.present.items()):
                if time.monotonic() > deadline_s:
                    raise SystemExit(f"not all connected within {CONNECT_S:g} s")
                time.sleep(0.05)
            yield
            for process in self.processes.values():
                assert process.stdin is not None
                process.stdin.close()
            for process in self.processes.values():
                process.wait(20.0)

    def _read(self, i: int, process: subprocess.Popen[str]) -> None:
        assert process.stdout is not None
        for line in process.stdout:
            told = json.loads(line)
            self.present[i].append((told["at_s"], frozenset(told["present"])))

    def rate(self, hz: float) -> None:
        """States at so many a second from now on; 0: as flown."""
        for process in self.processes.values():
            assert process.stdin is not None
            process.stdin.write(f"{hz}\n")
            process.stdin.flush()

    def sent(self) -> list[tuple[int, int]]:
        """Packets and bytes that each vehicle's interface has sent."""
        counts = []
        for i in range(1, self.vehicles + 1):
            # The other end, on the bridge, has received what the vehicle's has sent.
            folder = f"/sys/class/net/v{i}/statistics"
            read = ["ip", "netns", "exec", f"{TAG}-air", "cat", f"{folder}/rx_packets", f"{folder}/rx_bytes"]
            packets, octets = subprocess.run(read, check=True, capture_output=True, text=True).stdout.split()
            counts.append((int(packets), int(octets)))
        return counts

    def measure(self, seconds: float) -> tuple[float, float]:
        """Packets and bytes that a vehicle sends a second."""
        began_s, before = time.monotonic(), self.sent()
        time.sleep(seconds)
        lasted_s, after = time.monotonic() - began_s, self.sent()
        each = [((b[0] - a[0]) / lasted_s, (b[1] - a[1]) / lasted_s) for a, b in zip(before, after, strict=True)]
        return mean(p for p, _ in each), mean(b for _, b in each)

    def cut(self, i: int, wait_s: float) -> list[float]:
        """Cut one vehicle's interface; after how many seconds each other one noticed."""
        began_s = time.monotonic()
        ip("-n", f"{TAG}-air", "link", "set", f"v{i}", "down")
        time.sleep(wait_s)
        ip("-n", f"{TAG}-air", "link", "set", f"v{i}", "up")
        noticed = []
        for other, seen in self.present.items():
            if other != i:
                noticed += [at_s - began_s for at_s, ids in seen if at_s > began_s and i not in ids][:1]
        return noticed


@app.callback(invoke_without_command=True)
def bench(
    context: typer.Context,
    vehicles: Annotated[int, typer.Option(min=2, max=100)] = 10,
    notice: Annotated[list[float] | None, typer.Option(help="peers.notice_lost_s; may be given again.")] = None,
    seconds: Annotated[float, typer.Option(min=5, help="Of steady flight that are counted.")] = 45.0,
) -> None:
    """Count packets and bytes of steady flight, of 20 Hz, and the time until a cut is noticed."""
    if context.invoked_subcommand is not None:
        return
    if os.geteuid() != 0:
        raise SystemExit("tests.bench.packets makes network namespaces: run it as root")
    rows = []
    for notice_s in notice or [2.0, 4.0, 10.0]:
        config = tables(vehicles, notice_s)
        parse(config, "fleet.toml")
        rig = Rig(vehicles)
        try:
            rig.build()
            with rig.flying(config):
                time.sleep(SETTLE_S)
                flown = rig.measure(seconds)
                rig.rate(COMPARED_HZ)
                time.sleep(SETTLE_S)
                compared = rig.measure(COMPARED_S)
                rig.rate(0.0)
                time.sleep(SETTLE_S)
                noticed = rig.cut(vehicles // 2, notice_s + SETTLE_S)
        finally:
            rig.remove()
        rows.append({
            "notice_lost_s": notice_s, "vehicles": vehicles,
            "packets_hz": round(flown[0], 2), "bytes_per_s": round(flown[1]),
            "at_20_hz": {"packets_hz": round(compared[0], 1), "bytes_per_s": round(compared[1])},
            "fewer_packets_percent": round(100.0 * (1.0 - flown[0] / compared[0]), 2),
            "fewer_bytes_percent": round(100.0 * (1.0 - flown[1] / compared[1]), 2),
            "least_packets_hz": round((vehicles - 1) / notice_s, 2),
            "cut_noticed_by": len(noticed),
            "cut_noticed_s": [round(min(noticed), 2), round(max(noticed), 2)] if noticed else None,
            "load": os.getloadavg()[0],
        })  # fmt: skip
        typer.echo(json.dumps(rows[-1]))


if __name__ == "__main__":
    app()
