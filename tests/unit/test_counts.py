"""Counters have a fixed set of names, whatever comes in."""

import ast
import copy
import json
from collections.abc import Iterator
from dataclasses import replace
from math import inf
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

import companion
from companion.config import load
from companion.core.counts import OTHER, Counts, RefusalKind
from companion.core.failsafe import Failsafe
from companion.core.frames import Ned
from companion.core.neighbours.table import COUNTED as SAMPLES_COUNTED
from companion.core.safety.filter import ACTING
from companion.core.trajectory.fleet import FleetTrajectory
from companion.core.trajectory.legs import TurnLeg, VelocityLeg
from companion.core.trajectory.successors import with_formation, with_legs
from companion.core.values import Instant
from companion.vehicle.agent import REJECTED, Agent
from companion.vehicle.autopilot.px4 import COUNTED
from companion.wire import mavlink
from companion.wire.operator import encode
from companion.wire.peer import encode_motion

ROOT = Path(companion.__file__).resolve().parent
FLEET = load(ROOT.parent / "fleet.toml")
UNFENCED = load(ROOT.parent / "fleet.toml", lambda tables: tables.pop("fence"))
NOW = Instant(5_000_000_000, 1_700_000_000_000_000_000)
HOUR_NS = 3_600_000_000_000


@given(st.lists(st.sampled_from(["a", "b", "c", "d", OTHER]) | st.text(max_size=4)))
def test_whatever_is_counted_the_names_are_the_known_ones_and_other_and_nothing_is_lost(names: list[str]) -> None:
    one_by_one, at_once = Counts(("a", "b")), Counts(("a", "b"))
    for name in names:
        one_by_one[name] += 1
    at_once.update(names)
    assert one_by_one == at_once
    assert set(one_by_one) <= {"a", "b", OTHER}
    assert sum(one_by_one.values()) == len(names)
    assert one_by_one["a"] == names.count("a")
    assert one_by_one["c"] == one_by_one[OTHER]


def test_a_copy_counts_on_by_itself_under_the_same_names() -> None:
    counts = Counts(("a",))
    counts["a"] += 2
    for other in (copy.deepcopy(counts), counts.copy()):
        other["a"] += 1
        other["x"] += 1
        assert other == {"a": 3, OTHER: 1}
    assert counts == {"a": 2}
    assert Counts(("a",)) + counts == {"a": 2}


def counted_names() -> Iterator[tuple[str, str]]:
    """(file, name) of each literal under which the companion counts."""
    for path in ROOT.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.AugAssign) and isinstance(node.target, ast.Subscript):
                owner, key = node.target.value, node.target.slice
                if isinstance(owner, ast.Attribute) and owner.attr in ("rejected", "counts"):
                    for part in ast.walk(key):
                        if isinstance(part, ast.Constant) and not isinstance(key, ast.JoinedStr):
                            yield path.name, str(part.value)


def test_every_name_that_the_code_counts_under_is_among_those_its_counter_knows() -> None:
    known = {*REJECTED, *COUNTED, *SAMPLES_COUNTED, *ACTING, *mavlink.REJECTED, *(f.value for f in Failsafe)}
    names = set(counted_names())
    assert len(names) > 10
    assert {(file, name) for file, name in names if name not in known} == set()


def formed(agent: Agent) -> FleetTrajectory:
    return with_formation(
        agent.history.newest, at_ns=NOW.fleet_ns, issuer=0, shape=FLEET.formation.shape,
        slots=FLEET.slots(FLEET.formation.shape), pinned=FLEET.pinned, speed_m_s=1.0,
    )  # fmt: skip


def refused(sound: FleetTrajectory) -> dict[RefusalKind, FleetTrajectory]:
    """Motions that are refused, by the reason."""
    at_ns = NOW.fleet_ns + 1_000_000_000

    def flown(*legs: VelocityLeg | TurnLeg) -> FleetTrajectory:
        return with_legs(sound, at_ns=at_ns, issuer=0, legs=legs)

    return {
        RefusalKind.REVISION: replace(sound, revision=sound.revision + 20_000),
        RefusalKind.VEHICLES: replace(sound, slots={i: s for i, s in sound.slots.items() if i > 1}),
        RefusalKind.START: replace(sound, start_ns=NOW.fleet_ns + 2 * HOUR_NS),
        RefusalKind.SPEED: flown(VelocityLeg(Ned(3.5, 0.0, 0.0), 1.0)),
        RefusalKind.FENCE: flown(VelocityLeg(Ned(1.0, 0.0, 0.0), 10_000.0)),
        RefusalKind.CLIMB: flown(VelocityLeg(Ned(0.0, 0.0, -0.5), 5.0)),
        RefusalKind.SHAPE: replace(sound, shape="custom"),
        RefusalKind.NO_LEG: replace(sound, velocity_ned_m_s=Ned(0.0, 0.0, -0.5)),
        RefusalKind.ENDLESS: flown(TurnLeg(0.1, inf), VelocityLeg(Ned(1.0, 0.0, 0.0), 5.0)),
    }


@pytest.mark.parametrize("kind", list(refused(formed(Agent(FLEET, 1, 7)))))
def test_a_refused_motion_counts_under_its_kind_and_its_sentence_is_not_a_name(kind: RefusalKind) -> None:
    agent = Agent(UNFENCED if kind is RefusalKind.CLIMB else FLEET, 1, 7)
    motion = refused(formed(agent))[kind]
    agent.receive_peer("fleet/2/plan", encode_motion(motion), NOW)
    assert agent.rejected == {f"plan: {kind}": 1}
    order = {"verb": "motion", "id": "a", "issuer": "x", "after": {"1": [[7, 0, 0]]}}
    payload = json.dumps({**order, "motion": json.loads(encode_motion(motion))})
    said = json.loads(agent.receive_command(payload.encode(), NOW))
    assert (said["accepted"], len(said["reason"]) > 10) == (False, True)
    assert agent.rejected == {f"plan: {kind}": 2}


def test_two_thousand_refused_plans_of_as_many_revisions_leave_the_status_as_small_as_one() -> None:
    agent = Agent(FLEET, 1, 7)
    sound = formed(agent)
    sizes = []
    for n in range(2000):
        agent.receive_peer("fleet/2/plan", encode_motion(replace(sound, revision=20_000 + n)), NOW)
        sizes.append(len(encode(agent.status(NOW)))) if n in (0, 1999) else None
    assert set(agent.rejected) == {f"plan: {RefusalKind.REVISION}", "plan: more than can be examined"}
    assert sum(agent.rejected.values()) == 2000
    assert sizes[1] - sizes[0] <= 60
