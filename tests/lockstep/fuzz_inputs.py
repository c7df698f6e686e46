"""Inputs that decoders let through: made from honest ones, changed within the bounds of single values, or extreme.

For agents in lockstep and for companions behind Zenoh. A fleet that believes them may fly badly; it may not fall over.
What is meant to end a flight (land, release, kill, a plan that lands) is left out, or has one thing wrong with it.
"""

import json
from collections.abc import Callable
from dataclasses import replace
from math import inf, pi
from random import Random
from typing import Any, Literal, NamedTuple

from companion.config import FleetConfig
from companion.core.frames import Ned
from companion.core.trajectory.fleet import PADS, REVISIONS, FleetTrajectory
from companion.core.trajectory.goto import GOTO_MIN_S
from companion.core.trajectory.legs import GotoLeg, Leg, TurnLeg, VelocityLeg
from companion.core.trajectory.slots import BLEND_MIN_S, SlotChange
from companion.core.trajectory.successors import with_legs
from companion.core.trajectory_check import (
    DURATION_MAX_S,
    LEGS_MAX,
    PLACE_MAX_M,
    TURN_ANGLE_MAX_RAD,
    TURN_ANGLE_MIN_RAD,
    TURN_RATE_MAX_RAD_S,
    TURN_RATE_MIN_RAD_S,
    VELOCITY_MAX_M_S,
)
from companion.core.values import ZERO, PeerMessage, PeerSample, Phase
from companion.wire.peer import PLAUSIBLE_MAX, encode_motion, encode_state

SHAPES = ("v", "line", "column", "circle", "grid", "spiral", "sphere")


class Input(NamedTuple):
    """One input: a put under a key, or a question."""

    kind: Literal["plan", "state", "command", "status", "preflight", "presence"]
    key: str
    payload: bytes


class Inputs:
    """An endless choice of inputs from one seed."""

    def __init__(self, config: FleetConfig, seed: int) -> None:
        self.config = config
        self.random = Random(seed)
        self.ids = [v.id for v in config.vehicles]
        self.orders = 0

    def one(self, newest: FleetTrajectory, fleet_ns: int) -> Input:
        """Whatever comes next, given the newest motion and the time of whom it is for."""
        r = self.random
        about = r.choice(self.ids)
        match r.choices(("plan", "state", "command", "status", "preflight", "presence"), (40, 35, 18, 2, 2, 3))[0]:
            case "plan":
                return Input("plan", f"fleet/{about}/plan", encode_motion(self.motion(newest, fleet_ns)))
            case "state":
                return Input("state", f"fleet/{about}/state", encode_state(self.message(about, newest, fleet_ns)))
            case "command":
                return Input("command", "", self.command(newest, fleet_ns))
            case "status":
                return Input("status", "", b"")
            case "preflight":
                return Input("preflight", "", b"")
            case _:
                return Input("presence", "", bytes((about, r.random() < 0.8)))

    # -- motions -----------------------------------------------------------------------------------------------------

    def number(self, low: float, high: float) -> float:
        """Anything between two bounds, often a bound."""
        r = self.random
        near = min(max(r.choice([0.0, 1e-9, -1e-9, 1.0, -1.0, 10.0]), low), high)
        return r.choice([low, high, near, r.uniform(low, high), r.uniform(max(low, -100.0), min(high, 100.0))])

    def place(self) -> Ned:
        r = self.random
        if r.random() < 0.1:
            return Ned(*(self.number(-PLACE_MAX_M, PLACE_MAX_M) for _ in range(3)))
        reach = r.choice([5.0, 40.0, 190.0])
        return Ned(r.uniform(-reach, reach), r.uniform(-reach, reach), -r.choice([1.0, 3.0, 12.0, 49.0]))

    def velocity(self) -> Ned:
        r = self.random
        if r.random() < 0.1:
            return Ned(*(self.number(-VELOCITY_MAX_M_S, VELOCITY_MAX_M_S) for _ in range(3)))
        return Ned(r.uniform(-1.5, 1.5), r.uniform(-1.5, 1.5), r.choice([0.0, 0.0, 0.2, -0.2]))

    def leg(self) -> Leg:
        r = self.random
        match r.randrange(3):
            case 0:
                return VelocityLeg(self.velocity(), r.choice([0.0, 1.0, 20.0, self.number(0.0, DURATION_MAX_S)]))
            case 1:
                rate = self.number(TURN_RATE_MIN_RAD_S, r.choice([0.1, TURN_RATE_MAX_RAD_S]))
                angle = self.number(TURN_ANGLE_MIN_RAD, r.choice([pi, TURN_ANGLE_MAX_RAD]))
                return TurnLeg(r.choice([rate, -rate]), r.choice([angle, angle, inf]))
            case _:
                return GotoLeg(self.place(), r.choice([GOTO_MIN_S, 30.0, 120.0, self.number(60.0, DURATION_MAX_S)]))

    def motion(self, newest: FleetTrajectory, fleet_ns: int) -> FleetTrajectory:
        """An honest successor of the newest motion, mostly with some of its values changed."""
        r = self.random
        at_ns = fleet_ns + r.choice([2_000_000_000, 3_000_000_000, 0, -5_000_000_000, 3_500_000_000_000])
        at_ns = max(at_ns, newest.start_ns + 1)
        match r.randrange(4):
            case 0:
                motion = self.config.motion_into(r.choice(SHAPES), newest, at_ns, r.choice([0, *self.ids]))
            case 1:
                motion = replace(self.config.motion_home(newest, at_ns, 0), then="stay")
            case _:
                legs = tuple(self.leg() for _ in range(r.choice([0, 1, 1, 2, 5, 30, LEGS_MAX])))
                motion = with_legs(newest, at_ns=at_ns, issuer=r.randrange(256), legs=legs, then="stay")
        for _ in range(r.choice([0, 1, 1, 2, 4])):
            motion = self.changed(motion, fleet_ns)
        return replace(motion, then="stay") if motion.then == "land" or motion.shape == PADS else motion

    def changed(self, motion: FleetTrajectory, fleet_ns: int) -> FleetTrajectory:
        """The same with one value changed."""
        r = self.random
        slot = r.choice(list(motion.slots))
        now = r.choice([0, fleet_ns, fleet_ns - 10**10, fleet_ns + 10**10, 2**63 - 1, motion.start_ns])
        makers: list[Callable[[], dict[str, Any]]] = [
            lambda: {"revision": motion.revision + r.choice([-1, 0, 1, 9_998, 2**31])},
            lambda: {"start_ns": now},
            lambda: {"legs_start_ns": now},
            lambda: {"blend_start_ns": now},
            lambda: {"blend_s": r.choice([0.0, BLEND_MIN_S, DURATION_MAX_S, r.uniform(BLEND_MIN_S, 100.0)])},
            lambda: {"centre_ned_m": self.place()},
            lambda: {"velocity_ned_m_s": self.velocity()},
            lambda: {"heading_rad": self.number(-pi, pi)},
            lambda: {"heading_rate_rad_s": self.number(-TURN_RATE_MAX_RAD_S, TURN_RATE_MAX_RAD_S)},
            lambda: {"heading_follows_turns": not motion.heading_follows_turns},
            lambda: {"shape": r.choice([*SHAPES, PADS, "custom", "", "star"])},
            lambda: {"legs": (*motion.legs, self.leg())[-LEGS_MAX:]},
            lambda: {"slots": {**motion.slots, slot: SlotChange(self.place(), motion.slots[slot].after)}},
            lambda: {"slots": {**motion.slots, slot: SlotChange(ZERO, self.place())}},
            lambda: {"slots": {**motion.slots, r.randrange(1, 251): motion.slots[slot]}},
            lambda: {"slots": {i: SlotChange(c.after, c.before) for i, c in motion.slots.items()}},
        ]
        changed = replace(motion, **r.choice(makers)())
        return replace(
            changed, revision=min(max(changed.revision, 0), REVISIONS - 1), then=r.choice(["stay", motion.then])
        )

    # -- messages and commands ---------------------------------------------------------------------------------------

    def sample(self, about: int, newest: FleetTrajectory, fleet_ns: int) -> PeerSample:
        r = self.random
        place = newest.reference(about, fleet_ns).position_ned_m if about in newest.slots else ZERO
        spread = r.choice([0.0, 0.3, 3.0, 300.0, PLAUSIBLE_MAX - 1e5])
        fast = r.choice([0.0, 1.0, 10.0, PLAUSIBLE_MAX])
        return PeerSample(
            about, fleet_ns + r.choice([0, -(10**8), -(10**10), 9 * 10**8, -(2**62), 2**62]),
            Ned(*(x + r.uniform(-spread, spread) for x in place)), Ned(*(r.uniform(-fast, fast) for _ in range(3))),
            min(r.choice([newest.revision, 0, newest.revision + 1, REVISIONS - 1]), REVISIONS - 1),
            r.choice(list(Phase)),
        )  # fmt: skip

    def message(self, about: int, newest: FleetTrajectory, fleet_ns: int) -> PeerMessage:
        """A peer's state with a digest, true or not."""
        r = self.random
        digest = tuple(
            self.sample(r.choice([*self.ids, 0, 251]), newest, fleet_ns) for _ in range(r.choice([0, 1, 3, 30]))
        )
        return PeerMessage(
            r.choice([about, r.getrandbits(32)]), r.choice([r.randrange(100), r.getrandbits(32)]),
            r.choice([newest.start_ns, 0, 2**63 - 1, -(2**63)]), r.randrange(256),
            self.sample(about, newest, fleet_ns), digest,
        )  # fmt: skip

    def command(self, newest: FleetTrajectory, fleet_ns: int) -> bytes:
        """An operator's command; one that would end a flight has something wrong with it."""
        r = self.random
        self.orders += r.choice([0, 1, 1])
        order: dict[str, Any] = {
            "verb": r.choice(["motion", "motion", "motion", "takeoff", "resume"]), "revision": self.orders,
            "issuer": r.choice(["fuzz", "f" * 64]), "motion": json.loads(encode_motion(self.motion(newest, fleet_ns))),
        }  # fmt: skip
        match r.randrange(6):
            case 0:
                order |= {"verb": "kill", "confirm": r.choice([False, None, 1, "true", []])}
            case 1:
                order |= {"verb": r.choice(["land", "release"]), "issuer": r.choice(["", "f" * 65, 7, None])}
            case 2:
                order["motion"] = r.choice([None, [], {}, "x", 1e300, order["motion"] | {"legs": [{"kind": "turn"}]}])
        return json.dumps(order).encode()
