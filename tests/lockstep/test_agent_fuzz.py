"""Whatever comes in, an agent does not fall over, and what it sends is finite and within its limits."""

import itertools
import json
import os
import random
import struct
import sys
from collections.abc import Callable
from math import inf, nan
from typing import Any

import pytest
from flights import Tape, check_setpoint, fleet, launch, parse, until_formed
from fuzz_inputs import Input, Inputs
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import development as dialect

from companion.core.counts import OTHER
from companion.core.frames import Ned
from companion.core.values import Instant, PeerMessage, PeerSample, Phase
from companion.errors import WireError
from companion.vehicle.agent import Agent
from companion.wire.operator import encode
from companion.wire.peer import VERSION, decode_motion, decode_state, encode_motion, encode_state
from sim.lockstep.clockwork import UTC_AT_START_NS
from sim.lockstep.lockstep import Lockstep

pytestmark = pytest.mark.timeout(600)
"""a flight is simulated within a test, on whatever machine"""

CONFIG = fleet(3)
WORLD: Any = dialect.MAVLink(None, srcSystem=1, srcComponent=1)


IDS = itertools.count()


def ordered(agent: Agent, motion: bytes) -> bytes:
    """A command to fly a motion, given at a vehicle's place."""
    head = {"id": f"{next(IDS)}", "issuer": "x", "after": {agent.id: [agent.operator.place]}}
    return b'{"verb":"motion",%s,"motion":%s}' % (json.dumps(head)[1:-1].encode(), motion)


class Noise:
    """Bytes that nobody should send, made from those that somebody sent."""

    def __init__(self, seed: int) -> None:
        self.random = random.Random(seed)
        self.heard: dict[str, list[bytes]] = {}

    def remember(self, channel: str, body: bytes) -> None:
        kept = self.heard.setdefault(channel, [])
        kept.append(body)
        if len(kept) > 40:
            kept.pop(self.random.randrange(40))

    def spoil(self, body: bytes) -> bytes:
        r = self.random
        spoilt = bytearray(body)
        match r.randrange(5):
            case 0:
                return bytes(spoilt[: r.randrange(len(spoilt) + 1)])
            case 1:
                return bytes(spoilt) + r.randbytes(r.randrange(40))
            case 2:
                return r.randbytes(r.randrange(300))
        for _ in range(r.randrange(1, 8)):
            if spoilt:
                spoilt[r.randrange(len(spoilt))] = r.randrange(256)
        return bytes(spoilt)

    def number(self) -> float:
        return self.random.choice([nan, inf, -inf, 0.0, -0.0, 1e-45, 3.4e38, -3.4e38, 1e6, 9e5, 1e3, -1e3, 5.0, -12.0])

    def numbers(self, count: int) -> list[float]:
        return [self.number() for _ in range(count)]

    def mavlink(self, boot_ms: int) -> bytes:
        """A datagram with a right checksum from the right sender, with wrong contents."""
        r = self.random
        makers: list[Callable[[], Any]] = [
            # Positions of the past and of the far future come too; that is what a clock that jumps looks like.
            lambda: dialect.MAVLink_local_position_ned_message(
                r.choice([boot_ms, boot_ms + 1, 0, 2**32 - 1]), *self.numbers(6)
            ),
            lambda: dialect.MAVLink_gps_global_origin_message(
                r.choice([-(2**31), 2**31 - 1, 0]), r.choice([-(2**31), 2**31 - 1, 0]), r.choice([0, 2**31 - 1]), 0
            ),
            lambda: dialect.MAVLink_estimator_status_message(0, r.randrange(65536), *self.numbers(8)),
            lambda: dialect.MAVLink_command_ack_message(
                r.choice([22, 176, 400, 511]), r.randrange(10), 0, 0, r.choice([0, 1, 255]), r.choice([0, 191])
            ),
            lambda: dialect.MAVLink_extended_sys_state_message(255, 255),
            lambda: dialect.MAVLink_param_value_message(r.randbytes(16), self.number(), r.randrange(12), 1, 0),
            lambda: dialect.MAVLink_sys_status_message(*[2**32 - 1] * 3, 0, 0, 0, -1, 0, 0, 0, 0, 0, 0),
        ]
        message = r.choice(makers)()
        return bytes(message.pack(WORLD))

    def state(self, now: Instant) -> tuple[str, bytes]:
        """A peer's message in the right form with wrong contents."""
        r = self.random

        def sample() -> bytes:
            when = now.fleet_ns + r.choice([0, -1, 10**9, 10**18, -(10**18), -(10**10)])
            return struct.pack("<q6f", max(min(when, 2**63 - 1), -(2**63)), *self.numbers(6))

        about, entries = r.randrange(256), r.randrange(4)
        payload = struct.pack(
            "<BBBBIIIqBBB", VERSION, about, r.randrange(15), entries, r.getrandbits(32), r.getrandbits(32),
            r.choice([0, 1, 2, 2**32 - 1]), r.choice([0, now.fleet_ns, 2**63 - 1, -(2**63)]), r.randrange(256),
            r.choice([0, 0, 1, 1, 7]), near := r.randrange(5),
        )  # fmt: skip
        payload += sample()
        for _ in range(entries):
            payload += struct.pack("<BBI", r.randrange(1, 5), r.randrange(15), r.getrandbits(32)) + sample()
        payload += bytes(r.choices(range(256), k=near) if r.random() < 0.2 else range(1, 1 + near))
        return f"fleet/{about}/state", payload

    def lie(self, vehicle_id: int, now: Instant) -> tuple[str, bytes]:
        """What a peer may well send, were it somewhere else."""
        r = self.random
        place, speed = r.choice([1.0, 10.0, 1e3, 1e6]), r.choice([0.0, 1.0, 30.0, 1e6])
        sample = PeerSample(
            vehicle_id, now.fleet_ns - r.choice([0, 10**7, 10**10]), Ned(*(r.uniform(-place, place) for _ in range(3))),
            Ned(*(r.uniform(-speed, speed) for _ in range(3))), 1, r.choice(list(Phase)),
        )  # fmt: skip
        message = PeerMessage(r.getrandbits(32), r.getrandbits(32), 0, 0, sample, (sample,))
        return f"fleet/{vehicle_id}/state", encode_state(message)

    def motion(self, ls: Lockstep) -> bytes:
        """A plan with one wrong thing in it."""
        r = self.random
        tree: Any = json.loads(encode_motion(ls.vehicles[1].agent.history.newest))
        tree["revision"] += r.randrange(3)
        tree["start_ns"] = r.choice([tree["start_ns"], ls.now.fleet_ns, ls.now.fleet_ns + 3_000_000_000, 0])
        wrong: list[Any] = [nan, inf, 1e300, 1e30, 1e5, -1e3, 5e-324, 0, "x", None, [], {}, True]
        place = r.choice(
            ["centre_ned_m", "velocity_ned_m_s", "slots", "legs", "blend_s", "heading_rate_rad_s", "shape"]
        )
        match place:
            case "centre_ned_m" | "velocity_ned_m_s":
                tree[place][r.randrange(3)] = r.choice(wrong)
            case "slots":
                tree[place][r.choice(list(tree[place]))][r.randrange(2)][r.randrange(3)] = r.choice(wrong)
            case "legs":
                value = r.choice(wrong)
                tree[place] = [
                    {"kind": "velocity", "velocity_ned_m_s": [value, 0, 0], "duration_s": r.choice(wrong)},
                    {"kind": "turn", "rate_rad_s": r.choice(wrong), "angle_rad": r.choice(wrong)},
                    {"kind": "goto", "target_ned_m": [0, value, 0], "duration_s": r.choice(wrong)},
                ][r.randrange(3) :]
            case _:
                tree[place] = r.choice(wrong)
        return json.dumps(tree).encode()

    def trouble(self, ls: Lockstep, i: int) -> None:
        """One thing that should not come, to one agent."""
        r, agent, now = self.random, ls.vehicles[i].agent, ls.now
        WORLD.srcSystem = i
        match r.randrange(9):
            case 0:
                agent.receive_mavlink(self.spoil(r.choice(self.heard["input/mavlink"])), now)
            case 1:
                agent.receive_mavlink(self.mavlink(agent.autopilot.boot.last_boot_ms), now)
            case 2:
                key, _, payload = r.choice(self.heard["input/peer"]).partition(b"\0")
                agent.receive_peer(key.decode(), self.spoil(payload), now)
            case 3:
                agent.receive_peer(*self.state(now), now)
            case 4:
                agent.receive_peer(*self.lie(r.choice([1, 2, 3, 4]), now), now)
            case 5:
                agent.receive_peer(f"fleet/{r.choice([1, 2, 3, 4, 99])}/plan", self.motion(ls), now)
            case 6:
                name = r.choice(
                    ["", "state", "fleet/x/state", "fleet/1/state/plan", "fleet/1/other", "//", "fleet/1/plan"]
                )
                agent.receive_peer(name, r.randbytes(r.randrange(60)), now)
            case 7:
                agent.receive_presence(r.randrange(256), r.random() < 0.9, now)
            case 8:
                command = r.choice(
                    [b"", b"null", b"{}", b"[" * 5000, b'{"verb":{}}', b'{"verb":"motion"}', r.randbytes(20)]
                )
                if r.random() < 0.5:
                    command = ordered(agent, self.motion(ls))
                answer = json.loads(agent.receive_command(command, now))
                assert answer["accepted"] in (True, False)


def test_a_fleet_in_flight_survives_a_rain_of_nonsense_and_sends_none_itself() -> None:
    noise = Noise(11)
    sent = 0

    def record(i: int, channel: str, now: Instant, body: bytes) -> None:
        nonlocal sent
        noise.remember(channel, body)
        if channel == "output/mavlink":
            parse(body)
            sent += check_setpoint(body, CONFIG)

    ls = launch(CONFIG, seed=9, record=record)
    until_formed(ls)
    for _ in range(600):
        ls.run_until((ls.now_ns + 20_000_000) * 1e-9)
        for i in ls.vehicles:
            noise.trouble(ls, i)
    assert sent > 1000
    for v in ls.vehicles.values():
        status = v.agent.status(ls.now)
        assert sum(status.rejected.values()) > 200
        # However much comes, what is counted are kinds, and a status stays a message that can be sent.
        assert len(status.rejected) < 60
        assert len(encode(status)) < 20_000


# -- what is refused leaves no trace -----------------------------------------------------------------------------------


def refused(noise: Noise, ls: Lockstep, i: int) -> None:
    """One of everything that must be refused, to one agent."""
    agent, now = ls.vehicles[i].agent, ls.now
    other = 3 - i
    datagram = noise.heard["input/mavlink"][-1]
    agent.receive_mavlink(datagram[:-3], now)
    agent.receive_mavlink(datagram[:-1] + bytes((datagram[-1] ^ 1,)), now)
    agent.receive_mavlink(b"", now)
    WORLD.srcSystem = other
    agent.receive_mavlink(bytes(dialect.MAVLink_local_position_ned_message(0, *[0.0] * 6).pack(WORLD)), now)
    WORLD.srcSystem = i
    boot_ms = agent.autopilot.boot.last_boot_ms + 5
    for k, number in enumerate((nan, inf, -inf, 1e30)):
        numbers = [0.0] * 6
        numbers[k] = number
        agent.receive_mavlink(bytes(dialect.MAVLink_local_position_ned_message(boot_ms, *numbers).pack(WORLD)), now)
    agent.receive_mavlink(bytes(dialect.MAVLink_gps_global_origin_message(2**31 - 1, 0, 0, 0).pack(WORLD)), now)

    def state(about: int, **changed: Any) -> bytes:
        values: dict[str, Any] = {"time_ns": now.fleet_ns, "revision": 0, "phase": Phase.FORMED}
        values.update(position_ned_m=Ned(0.0, 0.0, -3.0), velocity_ned_m_s=Ned(0.0, 0.0, 0.0))
        values.update(changed)
        return encode_state(PeerMessage(5, 2**31, 0, 0, PeerSample(about, **values), ()))

    key = f"fleet/{other}/state"
    agent.receive_peer(key, state(other)[:-1], now)
    agent.receive_peer(key, b"\x01" + state(other)[1:], now)
    agent.receive_peer(key, state(other, position_ned_m=Ned(nan, 0.0, 0.0)), now)
    agent.receive_peer(key, state(other, velocity_ned_m_s=Ned(0.0, 1e30, 0.0)), now)
    agent.receive_peer(key, state(other, time_ns=now.fleet_ns + 2_000_000_000), now)
    agent.receive_peer(key, state(77), now)
    agent.receive_peer("fleet/77/state", state(77), now)
    agent.receive_peer("fleet/1/other", state(other), now)
    newest: Any = json.loads(encode_motion(agent.history.newest))
    for wrong in (
        {"version": 1}, {"slots": {"1": newest["slots"]["1"]}}, {"start_ns": 0}, {"shape": "star"},
        {"velocity_ned_m_s": [50, 0, 0]}, {"centre_ned_m": [nan, 0, 0]}, {"legs_start_ns": -1},
    ):  # fmt: skip
        plan = json.dumps({**newest, "revision": newest["revision"] + 1, **wrong}).encode()
        agent.receive_peer(f"fleet/{other}/plan", plan, now)
        agent.receive_command(ordered(agent, plan), now)
    agent.receive_presence(77, True, now)
    agent.receive_presence(77, False, now)
    for command in (b"", b"[]", b"[" * 5000, b"\xff", b'{"verb":"fly"}', b'{"verb":"motion"}', ordered(agent, b"1")):
        answer = json.loads(agent.receive_command(command, now))
        assert answer["accepted"] is False
        assert answer["reason"]


def outputs(rain: bool) -> tuple[str, dict[str, int]]:
    noise, tape = Noise(3), Tape()

    def record(i: int, channel: str, now: Instant, body: bytes) -> None:
        noise.remember(channel, body)
        if channel.startswith("output/"):
            tape(i, channel, now, body)

    ls = launch(fleet(2), seed=12, record=record)
    while ls.now_ns < 16_000_000_000:
        ls.run_until((ls.now_ns + 100_000_000) * 1e-9)
        for i in ls.vehicles if rain else ():
            refused(noise, ls, i)
    assert ls.all_in(Phase.FORMING)
    return str(tape.digest.hexdigest()), ls.vehicles[1].agent.status(ls.now).rejected


def test_what_is_refused_is_counted_and_changes_not_one_bit_of_what_is_sent() -> None:
    clean, _ = outputs(rain=False)
    rained, counted = outputs(rain=True)
    assert rained == clean
    for kind in (
        "malformed", "not finite", "out of range", "foreign system", "state: length", "state: version",
        "state: not finite", "state: out of range", "from the future", "state: id is not the key's", "foreign id",
        "peer: unknown topic", "plan: motion", "command: malformed", "command: motion",
        "command: unknown verb", "command: id", "plan: its vehicles are not this fleet's",
    ):  # fmt: skip
        assert counted[kind] > 50, (kind, counted)
    assert OTHER not in counted


# -- an agent on the ground, and any order of events -------------------------------------------------------------------

EVENTS = st.one_of(
    st.tuples(st.just("wait"), st.integers(0, 3_000_000_000)),
    st.tuples(st.just("mavlink"), st.binary(max_size=60)),
    st.tuples(st.just("position"), st.lists(st.floats(width=32), min_size=6, max_size=6)),
    st.tuples(
        st.just("heartbeat"), st.tuples(st.booleans(), st.sampled_from([0, 6 << 16, 4 << 16 | 2 << 24, 3 << 16]))
    ),
    st.tuples(st.just("origin"), st.tuples(st.integers(-(2**31), 2**31 - 1), st.integers(-(2**31), 2**31 - 1))),
    st.tuples(st.just("peer"), st.binary(max_size=120)),
    st.tuples(st.just("presence"), st.tuples(st.integers(0, 255), st.booleans())),
    st.tuples(st.just("command"), st.sampled_from([b'{"verb":"takeoff"}', b'{"verb":"land"}', b"", b"[]", b"1"])),
    st.tuples(st.just("stop"), st.none()),
)


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(st.lists(EVENTS, max_size=40))
def test_any_order_of_events_leaves_an_agent_that_goes_on(events: list[tuple[str, Any]]) -> None:
    agent = Agent(CONFIG, 2, boot_id=1)
    now_ns = 0
    WORLD.srcSystem = 2
    for kind, value in events:
        now_ns += 5_000_000
        now = Instant(now_ns, now_ns + UTC_AT_START_NS)
        match kind:
            case "wait":
                now_ns += value
            case "mavlink":
                agent.receive_mavlink(value, now)
            case "position":
                message = dialect.MAVLink_local_position_ned_message(now_ns // 1_000_000, *value)
                agent.receive_mavlink(bytes(message.pack(WORLD)), now)
            case "heartbeat":
                armed, mode = value
                message = dialect.MAVLink_heartbeat_message(2, 12, 128 * armed, mode, 3, 3)
                agent.receive_mavlink(bytes(message.pack(WORLD)), now)
            case "origin":
                agent.receive_mavlink(
                    bytes(dialect.MAVLink_gps_global_origin_message(*value, 488_000, 0).pack(WORLD)), now
                )
            case "peer":
                agent.receive_peer("fleet/1/state", bytes((VERSION, 1)) + value, now)
            case "presence":
                about, alive = value
                agent.receive_presence(about, alive, now)
            case "command":
                json.loads(agent.receive_command(value, now))
            case "stop":
                agent.stop(now)
        now = Instant(now_ns, now_ns + UTC_AT_START_NS)
        if agent.next_deadline_ns() <= now_ns:
            for datagram in agent.advance(now).mavlink:
                parse(datagram)
                check_setpoint(datagram, CONFIG)
        encode(agent.status(now))
    assert agent.next_deadline_ns() <= now_ns + 1_100_000_000


# -- what decoders let through -----------------------------------------------------------------------------------------

CALLS_MAX = 150_000
"""calls of Python functions within the handling of one input: the same on every machine; some 15 ms of a fast core"""


class Calls:
    """Counts calls of Python functions while it is entered."""

    def __enter__(self) -> "Calls":
        self.count = 0
        sys.setprofile(self._event)
        return self

    def __exit__(self, *_: object) -> None:
        sys.setprofile(None)

    def _event(self, frame: object, event: str, argument: object) -> None:
        self.count += event == "call"


def give(agent: Agent, given: Input, now: Instant) -> None:
    """Hand an input to an agent as its process does, without the guard that catches what raises."""
    match given.kind:
        case "plan" | "state":
            agent.receive_peer(given.key, given.payload, now)
        case "command":
            assert json.loads(agent.receive_command(given.payload, now))["accepted"] in (True, False)
        case "presence":
            agent.receive_presence(given.payload[0], bool(given.payload[1]), now)
        case "status":
            assert len(encode(agent.status(now))) < 40_000
        case "preflight":
            assert len(encode(agent.operator.preflight_report(now))) < 40_000


def flooded(seed: int, count: int) -> tuple[int, int, int]:
    """A flight of five that gets inputs while it flies: how many each in all, of those let through by decoders, and the
    most calls that one took."""
    config = fleet(5, altitude_m=10.0, change=lambda tables: tables.update(fence={**FENCE}))
    ls = launch(config, seed=seed)
    until_formed(ls)
    inputs, given, through, most = Inputs(config, seed), 0, 0, 0
    while given < count and any(v.agent.supervisor.steers for v in ls.vehicles.values()):
        ls.run_until((ls.now_ns + 20_000_000) * 1e-9)
        for i, v in ls.vehicles.items():
            for _ in range(8 if v.agent.supervisor.steers else 0):
                one = inputs.one(v.agent.history.newest, ls.now.fleet_ns)
                if one.kind in ("plan", "state"):
                    try:
                        (decode_motion if one.kind == "plan" else decode_state)(one.payload)
                    except WireError:
                        continue
                    one = one._replace(key=one.key.replace(f"fleet/{i}/", f"fleet/{i % 5 + 1}/"))
                    through += 1
                with Calls() as calls:
                    give(v.agent, one, ls.now)
                given, most = given + 1, max(most, calls.count)
    for v in ls.vehicles.values():
        rejected = v.agent.status(ls.now).rejected
        assert len(rejected) < 80, sorted(rejected)
    return given, through, most


FENCE = {"radius_m": 200.0, "floor_m": 2.0, "ceiling_m": 50.0}


def test_nothing_that_the_decoders_let_through_makes_an_agent_in_flight_raise_or_costs_it_much() -> None:
    given, through, most = flooded(seed=1, count=3000)
    assert given > 1000
    assert through > 0.5 * given
    assert most < CALLS_MAX


@pytest.mark.long
@pytest.mark.timeout(7200)
def test_two_hundred_thousand_inputs_that_the_decoders_let_through_are_withstood() -> None:
    """STARLING_FUZZ_INPUTS sets another number, STARLING_FUZZ_SEED another beginning."""
    wanted = int(os.environ.get("STARLING_FUZZ_INPUTS", "200000"))
    seed = int(os.environ.get("STARLING_FUZZ_SEED", "1000"))
    total = most = flights = 0
    while total < wanted:
        given, _, calls = flooded(seed + flights, min(wanted - total, 20_000))
        total, most, flights = total + given, max(most, calls), flights + 1
        sys.stdout.write(f"flight {flights}: {given} inputs, {total} in all, at most {most} calls each\n")
    assert most < CALLS_MAX
