"""Forged puts of a fault campaign: plans and states of valid form that mean harm. Pure.

Who sends them is inside the network, past its encryption, hears every put and knows the layout of the bytes.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from math import cos, inf, pi, sin
from random import Random

from companion.core.frames import Ned
from companion.core.trajectory.fleet import FleetTrajectory
from companion.core.trajectory.legs import GotoLeg, Leg, TurnLeg, VelocityLeg
from companion.core.trajectory.slots import SlotChange
from companion.core.trajectory.successors import with_legs
from companion.core.values import ZERO, PeerMessage, PeerSample, Phase
from companion.wire.peer import decode_state, encode_motion, encode_state

SECOND_NS = 1_000_000_000
START_NS = 3 * SECOND_NS
"""how far ahead a forged plan starts, where its start is not what is wrong with it"""
LEGS_MOST = 100
"""as many as the decoder lets through"""
SEQUENCE_LEAP = (1 << 31) - 5
"""the largest step of a sequence number that counts as newer, nearly"""


def forged_plan(kind: str, newest: FleetTrajectory, issuer: int, now_ns: int, random: Random) -> bytes:
    """A plan that takes over from `newest`, hostile in the way that `kind` names."""
    plain = with_legs(newest, at_ns=now_ns + START_NS, issuer=issuer, legs=())
    return encode_motion(PLANS[kind](plain, random))


def _legs(*legs: Leg) -> Callable[[FleetTrajectory, Random], FleetTrajectory]:
    return lambda plain, _: replace(plain, legs=legs)


def _every_slot(plain: FleetTrajectory, before: bool, after: bool) -> FleetTrajectory:
    """All vehicles to the centre, before the blend or after it."""
    slots = {i: SlotChange(ZERO if before else s.before, ZERO if after else s.after) for i, s in plain.slots.items()}
    return replace(plain, slots=slots, blend_start_ns=plain.start_ns, blend_s=3.0 if after else 3600.0)


def _exchanged(plain: FleetTrajectory, random: Random) -> FleetTrajectory:
    """Every vehicle into another's slot, within a tenth of a second."""
    ids = list(plain.slots)
    turn = random.randrange(1, len(ids)) if len(ids) > 1 else 0
    others = ids[turn:] + ids[:turn]
    slots = {i: SlotChange(plain.slots[i].after, plain.slots[j].after) for i, j in zip(ids, others, strict=True)}
    return replace(plain, slots=slots, blend_start_ns=plain.start_ns, blend_s=0.1)


def _at_another_time(plain: FleetTrajectory, random: Random) -> FleetTrajectory:
    """Under way for an hour, or an hour from now: where it leads to is long over, or never comes."""
    apart_ns = random.choice((-3590, 3590)) * SECOND_NS
    legs = (VelocityLeg(Ned(0.2, 0.0, 0.0), 30.0),)
    return replace(plain, start_ns=plain.start_ns + apart_ns, legs_start_ns=plain.start_ns + apart_ns, legs=legs)


def _leaping(plain: FleetTrajectory, random: Random) -> FleetTrajectory:
    """A revision that leaves no room for another, or as little as is let through."""
    return replace(plain, revision=random.choice(((1 << 32) - 1, plain.revision + 9_999)))


PLANS: Mapping[str, Callable[[FleetTrajectory, Random], FleetTrajectory]] = {
    "out of the fence": _legs(VelocityLeg(Ned(2.0, 0.0, 0.0), 60.0)),
    "into the ground": _legs(GotoLeg(Ned(0.0, 0.0, 5.0), 10.0)),
    "too fast": _legs(VelocityLeg(Ned(0.0, 15.0, 0.0), 5.0)),
    "a jump": _legs(GotoLeg(Ned(8.0, 0.0, -3.0), 0.1)),
    "collapsed slots": lambda plain, _: _every_slot(plain, before=False, after=True),
    "collapsed slots before": lambda plain, _: _every_slot(plain, before=True, after=False),
    "exchanged slots": _exchanged,
    "endless": _legs(TurnLeg(0.2, inf)),
    "endless, and then": _legs(VelocityLeg(Ned(0.5, 0.0, 0.0), 2.0), TurnLeg(0.2, inf), VelocityLeg(ZERO, 1.0)),
    "endless climb": _legs(VelocityLeg(Ned(0.0, 0.0, -0.5), 5.0)),
    "smallest angle": _legs(TurnLeg(0.2, 5e-324)),
    "spin": _legs(VelocityLeg(Ned(0.5, 0.0, 0.0), 2.0), TurnLeg(1.1, 1e6)),
    "heavy": _legs(*[TurnLeg(1.1, 1e6) for _ in range(LEGS_MOST)]),
    "at another time": _at_another_time,
    "revision leaps": _leaping,
    "nobody's slots": lambda plain, _: replace(plain, slots=dict(list(plain.slots.items())[:-1])),
}
"""how a plan is hostile"""


def forged_state(kind: str, heard: Mapping[int, bytes], liar: int, now_ns: int, random: Random) -> bytes | None:
    """A state under the liar's key, hostile in the way that `kind` names, from the last state heard of each vehicle.

    None where nothing was heard of the liar.
    """
    if liar not in heard:
        return None
    true = decode_state(heard[liar])
    sample = true.sample._replace(time_ns=now_ns)
    others = [decode_state(payload).sample._replace(time_ns=now_ns) for i, payload in heard.items() if i != liar]
    message = replace(true, sequence=(true.sequence + 1) % (1 << 32), sample=sample)
    return encode_state(STATES[kind](message, others, random))


Forger = Callable[[PeerMessage, list[PeerSample], Random], PeerMessage]


def _elsewhere(message: PeerMessage, others: list[PeerSample], _: Random) -> PeerMessage:
    """All others stand in a heap where the liar is."""
    place = message.sample.position_ned_m
    return replace(message, digest=tuple(s._replace(position_ned_m=place, velocity_ned_m_s=ZERO) for s in others))


def _landed(message: PeerMessage, others: list[PeerSample], _: Random) -> PeerMessage:
    """All others have landed below where they are."""
    return replace(
        message,
        digest=tuple(
            s._replace(position_ned_m=s.position_ned_m._replace(down=0.0), velocity_ned_m_s=ZERO, phase=Phase.LANDED)
            for s in others
        ),
    )


def _jumping(message: PeerMessage, others: list[PeerSample], random: Random) -> PeerMessage:
    """All others are somewhere within ten metres, each time elsewhere, and fast."""

    def moved(s: PeerSample) -> PeerSample:
        angle, way = random.uniform(0.0, 2.0 * pi), random.uniform(2.0, 10.0)
        p = s.position_ned_m
        place = Ned(p.north + way * cos(angle), p.east + way * sin(angle), p.down)
        return s._replace(position_ned_m=place, velocity_ned_m_s=Ned(3.0 * cos(angle), 3.0 * sin(angle), 0.0))

    return replace(message, digest=tuple(map(moved, others)))


def _itself_idle(message: PeerMessage, _: list[PeerSample], random: Random) -> PeerMessage:
    """The liar's companion has begun anew, and its vehicle stands at the fleet's origin."""
    idle = message.sample._replace(position_ned_m=ZERO, velocity_ned_m_s=ZERO, phase=Phase.IDLE)
    return replace(message, boot_id=random.getrandbits(32), sequence=1, sample=idle, digest=())


def _leaping_sequence(message: PeerMessage, _: list[PeerSample], __: Random) -> PeerMessage:
    """All true but for the number: whoever counts from it takes nothing of the liar's any more."""
    return replace(message, sequence=(message.sequence + SEQUENCE_LEAP) % (1 << 32), digest=())


STATES: Mapping[str, Forger] = {
    "others elsewhere": _elsewhere,
    "others landed": _landed,
    "others jump": _jumping,
    "itself begun anew": _itself_idle,
    "sequence leaps": _leaping_sequence,
}
"""how a state is hostile"""
