"""What of a motion is refused, with which sentence, and that nothing which can be read costs much or raises."""

import json
import random
from collections.abc import Callable
from dataclasses import replace
from math import cos, hypot, inf, pi, radians, sin
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.config import FleetConfig, load
from companion.config.overrides import plan_legs
from companion.core.budget import Bucket, ExaminationBudget
from companion.core.frames import Ned
from companion.core.route import LOOKS_MAX
from companion.core.trajectory.fleet import FleetTrajectory, TrajectoryState
from companion.core.trajectory.goto import GOTO_MIN_S
from companion.core.trajectory.legs import GotoLeg, Leg, TurnLeg, VelocityLeg, leg_duration_s
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
    examine,
)
from companion.core.values import ZERO, Instant
from companion.errors import ConfigError
from companion.operator.client import turn_leg
from companion.vehicle.agent import Agent
from companion.wire.peer import decode_motion, encode_motion

FILE = Path(__file__).resolve().parents[2] / "fleet.toml"
START_NS = 1_790_000_000_000_000_000
NOW = Instant(50_000_000_000, START_NS)


def configured(**tables: dict[str, Any]) -> FleetConfig:
    def change(read: dict[str, Any]) -> None:
        for name, values in tables.items():
            read[name].update(values)

    return load(FILE, change)


CONFIG = configured()
LIMITS = CONFIG.motion_limits
FIRST = CONFIG.first_motion
FORMED = replace(CONFIG.motion_into("v", FIRST, START_NS - 60 * 10**9, 0), revision=1)


def flown(*legs: Leg, **changed: object) -> FleetTrajectory:
    """A motion that follows the formed fleet's."""
    motion = with_legs(FORMED, at_ns=START_NS + 3 * 10**9, issuer=0, legs=legs)
    return replace(motion, **changed)  # type: ignore[arg-type]


def sentence(motion: FleetTrajectory) -> str:
    fault = examine(motion, LIMITS, FORMED).fault
    return "" if fault is None else fault.sentence


AHEAD = VelocityLeg(Ned(1.0, 0.0, 0.0), 10.0)


# -- what once raised ------------------------------------------------------------------------------------------------

OUTSIDE = flown(VelocityLeg(Ned(1.0, 0.0, 0.0), 1.0))
ONCE_RAISED = {
    "an endless turn with a leg behind it": flown(TurnLeg(0.1, inf), AHEAD),
    "an endless turn with a leg behind it, in flight": flown(AHEAD, TurnLeg(0.1, inf), AHEAD),
    "a start outside the fence with legs that are over": replace(
        OUTSIDE, centre_ned_m=Ned(500.0, 0.0, -10.0), legs_start_ns=OUTSIDE.start_ns - 3600 * 10**9
    ),
}


@pytest.mark.parametrize("name", ONCE_RAISED)
def test_a_motion_that_once_raised_is_refused_by_put_and_by_command(name: str) -> None:
    payload = encode_motion(ONCE_RAISED[name])
    agent = Agent(CONFIG, 1, boot_id=1)
    agent.receive_peer("fleet/2/plan", payload, NOW)
    assert agent.history.newest.revision == 0
    assert sum(n for kind, n in agent.rejected.items() if kind.startswith("plan: ")) == 1
    order = b'{"verb":"motion","revision":1,"issuer":"x","motion":%s}' % payload
    answer = json.loads(agent.receive_command(order, NOW))
    assert answer["accepted"] is False
    assert len(answer["reason"]) > 20


@pytest.mark.parametrize("angle", [5e-324, 1e-300, 1e-5])
def test_a_turn_of_next_to_nothing_is_refused_where_it_is_read(angle: float) -> None:
    agent = Agent(CONFIG, 1, boot_id=1)
    agent.receive_peer("fleet/2/plan", encode_motion(flown(TurnLeg(0.1, angle))), NOW)
    assert agent.rejected == {"plan: motion": 1}


# -- nothing that can be read raises or costs much -------------------------------------------------------------------


class Counted(FleetTrajectory):
    """A motion that counts how often it is looked at."""

    looked = 0

    def state_at(self, fleet_ns: int) -> TrajectoryState:
        type(self).looked += 1
        return super().state_at(fleet_ns)


def extremes(low: float, high: float) -> st.SearchStrategy[float]:
    return st.sampled_from([low, high, 0.5 * (low + high)]) | st.floats(low, high)


near = st.floats(-220.0, 220.0)
places = st.builds(Ned, near, near, st.floats(-60.0, 0.0)) | st.builds(
    Ned, *(extremes(-PLACE_MAX_M, PLACE_MAX_M) for _ in range(3))
)
speeds = st.floats(-2.0, 2.0) | extremes(-VELOCITY_MAX_M_S, VELOCITY_MAX_M_S)
velocities = st.just(ZERO) | st.builds(Ned, speeds, speeds, st.just(0.0) | speeds)
turning = extremes(-TURN_RATE_MAX_RAD_S, TURN_RATE_MAX_RAD_S) | st.just(TURN_RATE_MIN_RAD_S)
rates = turning.filter(lambda rate: abs(rate) >= TURN_RATE_MIN_RAD_S)
seconds = st.floats(0.0, 100.0) | extremes(0.0, DURATION_MAX_S)
legs: st.SearchStrategy[Leg] = st.one_of(
    st.builds(VelocityLeg, velocities, seconds),
    st.builds(TurnLeg, rates, extremes(TURN_ANGLE_MIN_RAD, TURN_ANGLE_MAX_RAD) | st.just(inf)),
    st.builds(GotoLeg, places, st.floats(GOTO_MIN_S, 300.0) | extremes(GOTO_MIN_S, DURATION_MAX_S)),
)
offsets = st.builds(Ned, *(st.floats(-30.0, 30.0) for _ in range(3))) | places
nanoseconds = st.integers(0, 2**63 - 1) | st.integers(START_NS - 10**14, START_NS + 10**11)
readable = st.builds(
    Counted,
    revision=st.integers(0, 2**32 - 1), start_ns=nanoseconds, issuer=st.integers(0, 255),
    shape=st.sampled_from(["v", "line", "pads", "star"]),
    slots=st.fixed_dictionaries({i: st.builds(SlotChange, offsets, offsets) for i in range(1, 11)})
    | st.just(FORMED.slots) | st.just(FIRST.slots),
    blend_start_ns=nanoseconds, blend_s=st.just(0.0) | extremes(BLEND_MIN_S, DURATION_MAX_S),
    legs_start_ns=nanoseconds, centre_ned_m=places, velocity_ned_m_s=velocities, heading_rad=extremes(-pi, pi),
    heading_rate_rad_s=st.just(0.0) | turning, heading_follows_turns=st.booleans(),
    legs=st.lists(legs, max_size=6).map(tuple), then=st.sampled_from(["stay", "land", "return"]),
)  # fmt: skip


def started_together(motion: FleetTrajectory) -> FleetTrajectory:
    """The same with times as an honest one has them, which most that are drawn have not."""
    return replace(
        motion, start_ns=START_NS, legs_start_ns=START_NS, blend_start_ns=START_NS,
        velocity_ned_m_s=motion.velocity_ned_m_s if motion.legs else ZERO,
    )  # fmt: skip


@settings(deadline=None, max_examples=300)
@given(readable, st.booleans(), st.sampled_from([FORMED, FIRST, None]))
def test_whatever_can_be_read_is_accepted_or_refused_with_a_sentence_at_a_bounded_cost(
    motion: FleetTrajectory, together: bool, before: FleetTrajectory | None
) -> None:
    motion = started_together(motion) if together else motion
    assert decode_motion(encode_motion(motion)) == FleetTrajectory(
        **{f: getattr(motion, f) for f in FleetTrajectory.__annotations__}
    )
    Counted.looked = 0
    fault, looks = examine(motion, LIMITS, before)
    assert fault is None or len(fault.sentence) > 10
    assert looks < 1.5 * LOOKS_MAX
    assert Counted.looked < 3 * LOOKS_MAX


@settings(deadline=None, max_examples=60)
@given(readable, st.booleans())
def test_an_agent_takes_or_refuses_whatever_can_be_read(motion: FleetTrajectory, together: bool) -> None:
    agent = Agent(CONFIG, 1, boot_id=1)
    motion = replace(started_together(motion) if together else motion, revision=motion.revision % 3)
    order = b'{"verb":"motion","revision":1,"issuer":"x","motion":%s}' % encode_motion(motion)
    assert json.loads(agent.receive_command(order, NOW))["accepted"] in (True, False)
    agent.receive_peer("fleet/2/plan", encode_motion(replace(motion, revision=3)), NOW)
    agent.advance(NOW)


def hard(random_: random.Random, count: int) -> FleetTrajectory:
    """Many legs beside the edge, with a formation that turns and changes."""
    edge = random_.choice([150.0, 185.0, 195.0])
    made: list[Leg] = []
    for _ in range(count):
        angle = random_.uniform(0.0, 0.5)
        to = Ned(edge * (1.0 - angle * angle / 2), edge * angle, -10.0)
        made.append(
            random_.choice(
                [GotoLeg(to, 300.0), TurnLeg(random_.choice([0.01, 0.1, -0.1]), random_.choice([1.0, 600.0])), AHEAD]
            )
        )
    changed = {i: SlotChange(c.after, c.before) for i, c in FORMED.slots.items()}
    return flown(
        *made, centre_ned_m=Ned(edge - 10.0, 0.0, -10.0), heading_follows_turns=True,
        slots=changed, blend_start_ns=START_NS, blend_s=random_.choice([8.0, 80_000.0]),
    )  # fmt: skip


def test_the_hardest_motions_known_take_bounded_looks_and_long_surveys_pass() -> None:
    random_ = random.Random(3)
    for _ in range(40):
        motion = hard(random_, random_.choice([2, 10, LEGS_MAX]))
        counted = Counted(**{f: getattr(motion, f) for f in FleetTrajectory.__annotations__})
        Counted.looked = 0
        examine(counted, LIMITS, FORMED)
        assert Counted.looked < 3 * LOOKS_MAX
    survey: list[Leg] = []
    for k in range(20):
        side = radians(15.0) * (-1 if k % 2 else 1)
        survey += [
            VelocityLeg(Ned(1.5 * (-1) ** k, 0.0, 0.0), 40.0), TurnLeg(side, pi / 2),
            VelocityLeg(Ned(0.0, 0.5, 0.0), 4.0), TurnLeg(side, pi / 2),
        ]  # fmt: skip
    assert len(survey) == 80
    survey_from = flown(*survey, centre_ned_m=Ned(-30.0, -120.0, -10.0))
    fault, looks = examine(survey_from, LIMITS, FORMED)
    assert fault is None
    assert looks < 0.75 * LOOKS_MAX


def test_telling_how_far_a_motion_leads_outside_a_fence_of_many_notches_costs_no_more_than_finding_it() -> None:
    ring = [(200.0 - 12.0 * (k % 2), pi * k / 60) for k in range(120)]
    corners = [[r * cos(angle), r * sin(angle)] for r, angle in ring]

    def change(tables: dict[str, Any]) -> None:
        del tables["fence"]["radius_m"]
        tables["fence"]["polygon_m"] = corners

    limits = load(FILE, change).motion_limits
    fault, looks = examine(flown(AHEAD, GotoLeg(Ned(250.0, 0.0, -10.0), 300.0)), limits, FORMED)
    assert fault is not None
    assert fault.breach is not None
    assert fault.breach.outside_m > 40.0
    assert looks < 1.5 * LOOKS_MAX


# -- what is refused, and by which words -----------------------------------------------------------------------------


def swapped(count: int) -> dict[int, SlotChange]:
    """The slots, those of the first ones passed round: they meet half-way."""
    ids = sorted(FORMED.slots)
    turned = {i: ids[(k + 1) % count] if k < count else i for k, i in enumerate(ids)}
    return {i: SlotChange(FORMED.slots[i].after, FORMED.slots[turned[i]].after) for i in ids}


MOVED = {i: SlotChange(Ned(f, r + 1.0, d), FORMED.slots[i].after) for i, ((_), (f, r, d)) in FORMED.slots.items()}
CLOSE = {i: SlotChange(Ned(0.08 * f, 0.08 * r, d), Ned(f, r, d)) for i, (_, (f, r, d)) in FORMED.slots.items()}
BLENDING = {"blend_start_ns": START_NS + 3 * 10**9}
REFUSED = [
    ("legs", flown(*[AHEAD] * (LEGS_MAX + 1)), "has 101 legs, may have 100"),
    ("endless", flown(AHEAD, TurnLeg(0.1, inf), AHEAD), "its leg 1 turns for ever, but legs follow"),
    ("drift", flown(velocity_ned_m_s=Ned(1.0, 0.0, 0.0)), "it has a velocity, but no leg"),
    ("long", flown(AHEAD, VelocityLeg(ZERO, 80_000.0), VelocityLeg(ZERO, 10_000.0)), "its leg 2 ends after 90010 s"),
    ("legs later", flown(AHEAD, legs_start_ns=START_NS + 4 * 10**9), "its legs start after it does"),
    ("legs long ago", flown(AHEAD, legs_start_ns=START_NS - 10**14), "its legs began 100003 s before it"),
    ("change later", flown(AHEAD, blend_start_ns=START_NS + 10**14), "starts more than a day after it does"),
    ("jump", flown(AHEAD, slots=MOVED, blend_s=0.0), "changes in no time"),
    ("fast start", flown(AHEAD, velocity_ned_m_s=Ned(0.0, 3.1, 0.0)), "its centre flies at 3.10 m/s, may 3 m/s"),
    ("fast leg", flown(AHEAD, VelocityLeg(Ned(0.0, 3.1, 0.0), 5.0)), "its leg 1 flies at 3.10 m/s, may 3 m/s"),
    ("fast waypoint", flown(GotoLeg(Ned(30.0, 0.0, -10.0), 10.0)), "its leg 0 flies at"),
    ("steep waypoint", flown(GotoLeg(Ned(0.0, 0.0, -20.0), 12.0)), "its leg 0 climbs at 1.56 m/s, may 1.125 m/s"),
    ("sudden waypoint", flown(VelocityLeg(Ned(2.0, 0.0, 0.0), 9.0), GotoLeg(Ned(12.5, 0.0, -10.0), 4.0)),
     "its leg 1 accelerates with"),
    ("sinking", flown(VelocityLeg(Ned(0.0, 0.0, 0.9), 5.0)), "its leg 0 sinks at 0.90 m/s, may 0.75 m/s"),
    ("low", flown(AHEAD, GotoLeg(Ned(0.0, 0.0, -0.9), 60.0)), "its leg 1 leads to 0.90 m above the origin"),
    ("turn rate", flown(AHEAD, TurnLeg(1.0, pi), heading_follows_turns=True), "in its leg 1"),
    ("left-over turn", flown(AHEAD, heading_rate_rad_s=1.0), "the slot of vehicle"),
    ("fast change", flown(AHEAD, slots={**FORMED.slots, 10: SlotChange(Ned(60.0, 0.0, 0.0), FORMED.slots[10].after)},
                          blend_s=8.0, **BLENDING), "the slot of vehicle 10 moves at"),
    ("slots too near", flown(AHEAD, slots=CLOSE, blend_s=30.0, **BLENDING), "its slots come within 0.32 m"),
    ("fence", flown(AHEAD, GotoLeg(Ned(250.0, 0.0, -10.0), 300.0)), "its leg 1 takes vehicle"),
    ("for ever", flown(VelocityLeg(Ned(0.0, 0.0, -0.5), 5.0)), "climbs or sinks for ever"),
    ("vehicles", replace(flown(AHEAD), slots={1: FORMED.slots[1]}), "its vehicles are not this fleet's"),
]  # fmt: skip


@pytest.mark.parametrize(("motion", "words"), [r[1:] for r in REFUSED], ids=[r[0] for r in REFUSED])
def test_a_motion_is_refused_for_what_is_wrong_with_it(motion: FleetTrajectory, words: str) -> None:
    assert words in sentence(motion)
    fault = examine(motion, LIMITS, FORMED).fault
    assert fault is not None
    assert not any(c.isdigit() for c in fault.kind), "kinds are counted: they have no numbers in them"
    assert f"leg {fault.leg}" in fault.sentence or fault.leg is None or fault.leg == len(motion.legs) - 1


@pytest.mark.parametrize(
    "motion",
    [
        flown(AHEAD, TurnLeg(0.1, pi), AHEAD, GotoLeg(Ned(0.0, 30.0, -12.0), 120.0)),
        flown(TurnLeg(radians(6.0), inf), velocity_ned_m_s=Ned(1.0, 0.0, 0.0), heading_follows_turns=True),
        flown(VelocityLeg(Ned(3.0, 0.0, 0.0), 20.0)),
        flown(AHEAD, slots=swapped(3), blend_s=30.0, **BLENDING),  # type: ignore[arg-type]
        CONFIG.motion_into("line", flown(AHEAD), START_NS + 5 * 10**9, 0),
        CONFIG.motion_into("line", flown(VelocityLeg(Ned(3.0, 0.0, 0.0), 40.0)), START_NS + 5 * 10**9, 0),
        CONFIG.motion_home(flown(VelocityLeg(Ned(2.5, 0.0, 0.0), 40.0)), START_NS + 20 * 10**9, 0),
    ],
)  # fmt: skip
def test_what_an_honest_fleet_flies_is_not_refused(motion: FleetTrajectory) -> None:
    before = replace(FORMED, slots=motion.slots) if motion.shape == "v" else FORMED
    fault = examine(motion, LIMITS, before).fault
    assert fault is None or (fault.kind == "its slots meet" and motion.shape == "v"), fault


def test_slots_that_begin_elsewhere_must_stay_apart_and_those_that_begin_where_they_are_may_pass() -> None:
    """A way back leads each over its own pad, and slots may pass each other on it: the safety filter keeps them."""
    passing = flown(AHEAD, slots=swapped(2), blend_s=30.0, **BLENDING)  # type: ignore[arg-type]
    assert sentence(passing) == ""
    shifted = {i: SlotChange(Ned(a.north, a.east, a.down + 0.1), b) for i, (a, b) in passing.slots.items()}
    assert "its slots come within" in sentence(replace(passing, slots=shifted))


def test_a_stop_is_taken_wherever_it_happens() -> None:
    stop = flown(VelocityLeg(ZERO, 0.0), velocity_ned_m_s=Ned(3.0, 0.0, 0.5), centre_ned_m=Ned(199.0, 0.0, -1.5))
    assert sentence(stop) == ""


# -- legs after turns are flown at the speed asked for -----------------------------------------------------------------


def peak_m_s(motion: FleetTrajectory, leg: int) -> float:
    """The centre's greatest speed within a leg, looked at in 160 parts: to 1e-4."""
    since, _, v, _ = motion.leg_starts[leg]
    whole = leg_duration_s(motion.legs[leg], v)
    times = (motion.legs_start_ns + round((since + whole * k / 160) * 1e9) for k in range(161))
    return max(hypot(*motion.state_at(t).centre.velocity) for t in times)


def unfenced(tables: list[dict[str, Any]]) -> FleetConfig:
    def change(read: dict[str, Any]) -> None:
        del read["fence"]
        read["plan"]["legs"] = tables

    return load(FILE, change)


def planned(text: str) -> tuple[FleetConfig, FleetTrajectory]:
    config = unfenced(plan_legs(text))
    formed = replace(FORMED, blend_s=0.0, slots={i: SlotChange(c.after, c.after) for i, c in FORMED.slots.items()})
    return config, with_legs(formed, at_ns=START_NS, issuer=0, legs=config.plan_legs(formed.centre_ned_m))


@pytest.mark.parametrize(
    ("text", "leg", "asked"),
    [
        ("turn:6:180,goto:10:0:1", 1, 1.0),
        ("velocity:0.7:0:30,turn:6:180,goto:10:0:0.8", 2, 0.8),
        ("velocity:1:0:25,turn:6:90,velocity:0:1:15,hold:4,goto:40:0:1.5", 4, 1.5),
        ("velocity:2:0:40,turn:-10:270,velocity:0:2:30,goto:-60:40:2.5", 3, 2.5),
    ],
)
def test_a_waypoint_after_a_turn_is_flown_at_the_speed_asked_for(text: str, leg: int, asked: float) -> None:
    _, motion = planned(text)
    assert peak_m_s(motion, leg) == pytest.approx(asked, rel=0.01)


def random_plan(r: random.Random) -> tuple[str, list[tuple[int, float]]]:
    """A plan with turns and waypoints, and (leg, speed asked) of its waypoints."""
    parts: list[str] = []
    waypoints = []
    for _ in range(r.randrange(1, 4)):
        for _ in range(r.randrange(0, 3)):
            kind = r.choice(["velocity", "turn", "hold"])
            if kind == "velocity":
                parts.append(f"velocity:{r.uniform(-2, 2):.3f}:{r.uniform(-2, 2):.3f}:{r.uniform(1, 40):.2f}")
            elif kind == "turn":
                parts.append(f"turn:{r.choice([-1, 1]) * r.uniform(1, 30):.3f}:{r.uniform(1, 400):.2f}")
            else:
                parts.append(f"hold:{r.uniform(0, 20):.2f}")
        speed = r.uniform(0.2, 3.0)
        waypoints.append((len(parts), speed))
        parts.append(f"goto:{r.uniform(-150, 150):.2f}:{r.uniform(-150, 150):.2f}:{speed!r}")
    return ",".join(parts), waypoints


def test_a_thousand_random_plans_fly_their_waypoints_at_the_speed_asked_for_within_a_per_cent() -> None:
    """But for those that begin faster, and those too short to reach it with the acceleration of a waypoint."""
    r = random.Random(13)
    base = unfenced([])
    tables = base.plan.model_copy()
    exact = limited = 0
    for _ in range(1000):
        text, waypoints = random_plan(r)
        plan = tables.model_validate_json(json.dumps({"legs": plan_legs(text)}))
        config = base.model_copy(update={"plan": plan})
        motion = with_legs(FORMED, at_ns=START_NS, issuer=0, legs=config.plan_legs(FORMED.centre_ned_m))
        for leg, asked in waypoints:
            _, _, v, _ = motion.leg_starts[leg]
            flown_m_s, may = peak_m_s(motion, leg), max(asked, hypot(*v))
            assert flown_m_s <= may * 1.01, (text, leg)
            if flown_m_s < may * 0.99:
                since, _, _, _ = motion.leg_starts[leg]
                whole = leg_duration_s(motion.legs[leg], v)
                bend = max(
                    hypot(*motion.state_at(START_NS + round((since + whole * k / 300) * 1e9)).centre.acceleration)
                    for k in range(301)
                )
                assert bend == pytest.approx(1.0, rel=0.01) or whole == pytest.approx(1.0), (text, leg)
                limited += 1
            else:
                exact += 1
    assert exact > 1500
    assert limited < 200


@pytest.mark.parametrize(("altitude", "may"), [(40.0, 1.125), (1.5, 0.75)])
def test_a_steep_waypoint_is_flown_within_the_vertical_limits(altitude: float, may: float) -> None:
    waypoint = {"kind": "goto", "north_m": 3.0, "east_m": 0.0, "altitude_m": altitude, "speed_m_s": 3.0}
    config = unfenced([waypoint])
    motion = with_legs(FORMED, at_ns=START_NS, issuer=0, legs=config.plan_legs(FORMED.centre_ned_m))
    fastest = max(abs(motion.state_at(START_NS + k * 10**8).centre.velocity.down) for k in range(1000))
    assert fastest == pytest.approx(may, rel=0.01)


BAD_PLANS = [
    ("velocity:1:0:20,turn:60:360", "track", "$.plan.legs[1] would be refused"),
    ("hold:10,velocity:1:0:20,goto:300:0:1", "fixed", "$.plan.legs[2] must stay inside the fence"),
    ("hold:86400,velocity:1:0:20", "fixed", "$.plan.legs[1] would be refused: ends after"),
    ("turn:0.01:36000", "fixed", "$.plan.legs[0] would be refused: ends after"),
]


@pytest.mark.parametrize(("text", "heading", "words"), BAD_PLANS, ids=[p[0] for p in BAD_PLANS])
def test_a_plan_of_file_or_flag_that_vehicles_would_refuse_names_its_leg_before_anything_starts(
    text: str, heading: str, words: str
) -> None:
    with pytest.raises(ConfigError) as caught:
        configured(plan={"legs": plan_legs(text), "heading": heading})
    assert words in str(caught.value)


# -- what examining costs an agent -------------------------------------------------------------------------------------


def test_a_bucket_pays_afterwards_and_refills_with_time() -> None:
    bucket = Bucket(10.0, 20.0)
    assert bucket.open(0)
    bucket.spend(25.0)
    assert not bucket.open(500_000_000)
    assert bucket.open(600_000_000)
    bucket.spend(1.0)
    assert not bucket.open(600_000_000)
    assert bucket.open(10**12)
    bucket.spend(20.0)
    assert not bucket.open(10**12)


def test_a_sender_that_rages_does_not_silence_the_others() -> None:
    budget = ExaminationBudget([1, 2])
    while budget.open(1, 0):
        budget.spend(1, 100.0)
    assert budget.open(2, 0)


def test_a_flood_of_the_hardest_plans_costs_looks_that_do_not_grow_with_it() -> None:
    """100 a second for ten seconds, each different, as nine peers: most are not even read. A good one passes then."""
    agent, random_ = Agent(CONFIG, 1, boot_id=1), random.Random(5)
    payloads = [encode_motion(replace(hard(random_, 40), issuer=k)) for k in range(20)]
    for k in range(1000):
        now = Instant(NOW.monotonic_ns + k * 10_000_000, NOW.fleet_ns + k * 10_000_000)
        payload = payloads[k % 20].replace(b'"heading_rad":0.0', b'"heading_rad":%.6f' % (1e-6 * k))
        agent.receive_peer(f"fleet/{2 + k % 9}/plan", payload, now)
    kinds = {kind: n for kind, n in agent.rejected.items() if kind.startswith("plan: ")}
    examined = sum(n for kind, n in kinds.items() if kind != "plan: more than can be examined")
    assert sum(kinds.values()) == 1000
    assert 10 < examined < 300
    later = Instant(NOW.monotonic_ns + 30 * 10**9, NOW.fleet_ns + 10 * 10**9)
    good = CONFIG.motion_into("v", FIRST, later.fleet_ns + 3 * 10**9, 2)
    agent.receive_peer("fleet/2/plan", encode_motion(good), later)
    assert agent.history.newest.revision == 1


def test_the_same_unsound_plan_again_is_not_examined_again() -> None:
    agent = Agent(CONFIG, 1, boot_id=1)
    payload = encode_motion(flown(AHEAD, GotoLeg(Ned(250.0, 0.0, -10.0), 300.0)))
    for k in range(50):
        agent.receive_peer("fleet/2/plan", payload, Instant(NOW.monotonic_ns + k, NOW.fleet_ns + k))
    assert agent.rejected == {"plan: it leads outside the fence": 1, "plan: refused before": 49}


def test_commanded_motions_are_examined_within_a_budget_of_their_own() -> None:
    agent = Agent(CONFIG, 1, boot_id=1)
    reasons = set()
    random_ = random.Random(6)
    for k in range(200):
        motion = encode_motion(hard(random_, 40))
        order = b'{"verb":"motion","id":"%d","issuer":"x","after":{"1":[[1,0,0]]},"motion":%s}' % (k, motion)
        reasons.add(json.loads(agent.receive_command(order, NOW))["reason"])
    assert "too many motions at once: command it again" in reasons
    later = Instant(NOW.monotonic_ns + 60 * 10**9, NOW.fleet_ns)
    good = encode_motion(CONFIG.motion_into("v", FIRST, NOW.fleet_ns + 3 * 10**9, 0))
    order = b'{"verb":"motion","id":"a","issuer":"y","after":{"1":[[1,0,0]]},"motion":%s}' % good
    assert json.loads(agent.receive_command(order, later))["accepted"] is True


def test_a_turn_from_the_command_line_is_the_files() -> None:
    leg = load(FILE, lambda t: t["plan"].update(legs=plan_legs("turn:6:90"))).plan_legs(ZERO)[0]
    assert turn_leg(6.0, 90.0) == leg
    both: list[Callable[[], Leg]] = [lambda: turn_leg(6.0, None), lambda: TurnLeg(radians(6.0), inf)]
    assert both[0]() == both[1]()
