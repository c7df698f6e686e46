"""The operator's verbs beyond motions: who obeys, in which order, and what the vehicle then does."""

import json
from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from flights import (
    InLockstep,
    distances,
    failsafes,
    fleet,
    launch,
    parse,
    straight,
    truth,
    until,
    until_formed,
    until_landed,
    wait,
)

from companion.core.trajectory.legs import VelocityLeg
from companion.core.trajectory.successors import with_legs
from companion.core.values import ZERO, Instant, Phase
from companion.operator.client import Operator, velocity_leg
from companion.vehicle.agent import Agent
from companion.wire.operator import Place
from companion.wire.peer import encode_motion
from companion.wire.px4 import Px4Mode
from sim.lockstep.lockstep import Lockstep

pytestmark = pytest.mark.timeout(600)
"""a flight is simulated within a test, on whatever machine"""


def stay(tables: dict[str, Any]) -> None:
    tables["plan"]["then"] = "stay"


def wait_for_orders(tables: dict[str, Any]) -> None:
    tables["plan"]["automatic"] = False


def aloft(count: int, record: Any = None) -> tuple[Lockstep, Operator]:
    """Vehicles that wait over their pads for a formation that nobody orders."""
    ls = launch(fleet(count, change=wait_for_orders), seed=4, record=record)
    until(ls, 20.0, lambda: ls.all_in(Phase.WAITING))
    wait(ls, 1.0)
    return ls, Operator(ls.config, InLockstep(ls))


def place(ls: Lockstep, i: int = 1) -> Place:
    """Where a vehicle says to be in the order of its commands."""
    return ls.vehicles[i].agent.status(ls.now).place


def order(verb: str, name: str, *after: Place, **more: object) -> bytes:
    """A command to vehicle 1, given at these places."""
    return json.dumps({"verb": verb, "id": name, "issuer": "me", "after": {1: after}, **more}).encode()


def said(ls: Lockstep, payload: bytes, i: int = 1) -> dict[str, Any]:
    answer: dict[str, Any] = json.loads(ls.command(payload, i)[i])
    return answer


def mode(ls: Lockstep, i: int) -> int:
    return ls.vehicles[i].autopilot.truth().custom_mode


def until_mode(ls: Lockstep, wanted: Px4Mode) -> None:
    """Let time pass until vehicle 1 is just in a mode, which its companion has not heard yet."""
    for _ in range(100):
        if mode(ls, 1) == wanted:
            return
        wait(ls, 0.01)
    raise AssertionError(mode(ls, 1))


# -- order -----------------------------------------------------------------------------------------------------------


def test_an_older_command_is_refused_with_the_reason_and_a_retry_is_answered_alike() -> None:
    ls, _ = aloft(1)
    before = place(ls)
    release = order("release", "a", before)
    first_answer = ls.command(release, 1)[1]
    assert json.loads(first_answer)["accepted"]
    assert place(ls) == before._replace(obeyed=before.obeyed + 1)
    late = said(ls, order("resume", "b", before))
    assert (late["accepted"], late["in_order"]) == (False, False)
    assert late["reason"] == "release by me was obeyed in between"
    assert Place(*late["place"]) == place(ls), "whoever is refused learns where the vehicle is"
    notes = len(ls.notes)
    wait(ls, 1.0)
    assert ls.command(release, 1)[1] == first_answer
    wait(ls, 1.0)
    assert len(ls.notes) <= notes + 1
    assert said(ls, order("resume", "c", place(ls)))["accepted"]


def test_a_refused_command_takes_no_place_in_the_order() -> None:
    ls, _ = aloft(1)
    before = place(ls)
    assert not said(ls, order("kill", "a", before))["accepted"], "without its confirmation"
    assert place(ls) == before
    assert said(ls, order("land", "b", before))["accepted"]


@pytest.mark.parametrize("verb", ["kill", "land", "release"])
def test_what_ends_a_flight_is_obeyed_whatever_came_in_between(verb: str) -> None:
    ls, operator = aloft(1)
    seen = place(ls)
    for shape in ("line", "v", "line"):
        assert operator.form(shape, ls.now.fleet_ns).all_accepted
        wait(ls, 0.1)
    assert place(ls).obeyed == seen.obeyed + 3
    assert not said(ls, order("takeoff", "t", seen))["in_order"]
    assert said(ls, order(verb, "x", seen, confirm=True))["accepted"]


@pytest.mark.parametrize("verb", ["kill", "land", "release"])
def test_what_was_captured_in_one_flight_does_not_end_a_later_one(verb: str) -> None:
    def hover(tables: dict[str, Any]) -> None:
        tables["plan"].update(automatic=False, then="stay")

    ls = launch(fleet(1, change=hover), seed=4)
    until(ls, 20.0, lambda: ls.all_in(Phase.WAITING))
    obeyed = order(verb, "obeyed", place(ls), confirm=True)
    lost = order(verb, "never came", place(ls), confirm=True)
    assert said(ls, obeyed)["accepted"]
    if verb == "release":
        assert said(ls, order("resume", "r", place(ls)))["accepted"]
    else:
        until(ls, 60.0, lambda: ls.all_in(Phase.LANDED))
        wait(ls, 3.0)
        assert said(ls, order("takeoff", "t", place(ls)))["accepted"]
    until(ls, 60.0, lambda: ls.all_in(Phase.WAITING))
    for payload in (obeyed, lost):
        said(ls, payload)
    wait(ls, 3.0)
    assert ls.all_in(Phase.WAITING)
    assert ls.vehicles[1].autopilot.truth().armed
    ls.kill(1)
    ls.restart(1)
    wait(ls, 0.5)
    answer = said(ls, order(verb, "before the restart", place(ls)._replace(boot_id=7), confirm=True))
    assert answer["reason"].startswith("it is for another companion of this vehicle")


class Unheard(InLockstep):
    """A link on which some vehicles' status is lost, or what all told at one time comes again."""

    def __init__(self, ls: Lockstep, *lost: int) -> None:
        super().__init__(ls)
        self.lost = lost
        self.stale: dict[int, tuple[bytes, ...]] | None = None
        self.sent: list[bytes] = []

    def ask(
        self, vehicle_ids: Iterable[int], kind: str, payload: bytes, timeout_s: float, retry_s: float
    ) -> dict[int, tuple[bytes, ...]]:
        if kind == "command":
            self.sent.append(payload)
        answers = super().ask(vehicle_ids, kind, payload, timeout_s, retry_s)
        if kind == "status" and self.stale is not None:
            answers, self.stale = self.stale, None
        return {i: () if kind == "status" and i in self.lost else a for i, a in answers.items()}


@pytest.mark.parametrize("verb", ["kill", "land", "release", "resume"])
def test_a_command_gets_through_to_a_vehicle_whose_status_was_lost(verb: str) -> None:
    ls = Lockstep(fleet(2))
    ls.run_until(2.0)
    assert said(ls, order("release", "z", place(ls)))["accepted"]
    link = Unheard(ls, 1)
    answers = getattr(Operator(ls.config, link, "me"), verb)()
    if verb == "resume":
        assert set(answers.refused.values()) == {"it is not armed"}
    else:
        assert answers.accepted == (1, 2)
        late = said(ls, link.sent[0])
        assert not late["accepted"], "the first, which named no place, is refused whenever it comes"


def test_of_two_operators_at_the_same_moment_the_one_who_ends_the_flight_gets_through() -> None:
    ls = Lockstep(fleet(1))
    ls.run_until(2.0)
    a, b = (Operator(ls.config, InLockstep(ls), issuer) for issuer in ("operator-b", "operator-a"))
    a.status()
    b.status()
    assert a.command("land").all_accepted
    assert b.command("kill", confirm=True).all_accepted


def test_of_two_operators_at_the_same_moment_one_is_told_what_the_other_did() -> None:
    ls, a = aloft(1)
    b = Operator(ls.config, InLockstep(ls), "b")
    a.status()
    b.status()
    assert a.command("release").all_accepted
    answers = b.command("resume")
    assert answers.refused == {1: f"release by {a.issuer} was obeyed in between"}
    assert answers.outdated == (1,)


def test_a_vehicle_that_lies_about_its_place_hurts_nobody_but_itself() -> None:
    ls, _ = aloft(3)

    class Liar(InLockstep):
        def ask(
            self, vehicle_ids: Iterable[int], kind: str, payload: bytes, timeout_s: float, retry_s: float
        ) -> dict[int, tuple[bytes, ...]]:
            answers = super().ask(vehicle_ids, kind, payload, timeout_s, retry_s)
            for i in (2,) if 2 in answers else ():
                told = json.loads(answers[i][0])
                answers[i] = (json.dumps({**told, "place": [2**62, 2**62, 10_001]}).encode(),)
            return answers

    answers = Operator(ls.config, Liar(ls)).land()
    assert answers.accepted == (1, 3)
    assert tuple(answers.refused) == (2,)
    until(ls, 30.0, lambda: {ls.phases()[i] for i in (1, 3)} == {Phase.LANDED})


def test_a_fleet_of_twenty_thousand_commands_and_motions_and_a_late_companion_obey_alike() -> None:
    ls, operator = aloft(3)
    for _ in range(20):
        for i in ls.vehicles:
            ls.command(b'{"verb":"resume"}', i)
    newest = ls.vehicles[1].agent.history.newest
    for revision in (10_000, 20_000):
        motion = with_legs(newest, at_ns=ls.now.fleet_ns, issuer=0, legs=(VelocityLeg(ZERO, 0.0),))
        payload = json.dumps(
            {"verb": "motion", "motion": json.loads(encode_motion(replace(motion, revision=revision)))}
        )
        assert all(json.loads(a)["accepted"] for a in ls.command(payload.encode()).values())
        wait(ls, 1.0)
    ls.kill(2)
    wait(ls, 1.0)
    ls.restart(2)
    until(ls, 10.0, lambda: ls.vehicles[2].agent.history.newest.revision == 20_000)
    assert operator.move(velocity_leg(0.3, 0.0, 0.0), ls.now.fleet_ns).all_accepted
    assert {v.agent.history.newest.revision for v in ls.vehicles.values()} == {20_001}
    assert operator.release().all_accepted


def test_a_fresh_fleet_takes_no_motion_far_ahead_of_what_its_peers_tell() -> None:
    ls = Lockstep(fleet(3, change=wait_for_orders))
    ls.run_until(6.0)
    newest = ls.vehicles[1].agent.history.newest
    motion = replace(with_legs(newest, at_ns=ls.now.fleet_ns, issuer=0, legs=()), revision=2**32 - 1)
    payload = json.dumps({"verb": "motion", "motion": json.loads(encode_motion(motion))}).encode()
    for answer in ls.command(payload).values():
        assert json.loads(answer)["reason"] == "its revision 4294967295 is more than 10000 ahead of 0, the newest known"


def test_a_hold_that_builds_on_an_old_motion_is_built_once_more_on_the_newest() -> None:
    ls, operator = aloft(2)
    link = Unheard(ls)
    link.stale = link.ask([1, 2], "status", b"", 1.0, 0.5)
    assert operator.form("line", ls.now.fleet_ns).all_accepted
    assert operator.move(velocity_leg(0.5, 0.0, 0.0), ls.now.fleet_ns).all_accepted
    wait(ls, 1.0)
    assert Operator(ls.config, link).hold(lambda: ls.now.fleet_ns).all_accepted
    for v in ls.vehicles.values():
        newest = v.agent.history.newest
        assert (newest.revision, newest.shape, newest.climb_at_end_m_s) == (3, "line", 0.0)


@pytest.mark.parametrize(
    ("payload", "why"),
    [
        (b'{"verb":"land"}', "id must be"), (order("land", ""), "id must be"), (order("land", "x" * 65), "id must be"),
        (b'{"verb":"land","id":"a"}', "issuer must be"), (b'{"verb":"land","id":"a","issuer":7}', "issuer must be"),
        (b'{"verb":"land","id":"a","issuer":"me"}', "after must be"), (order("fly", "a"), "unknown verb"),
        (b'{"verb":"land","id":"a","issuer":"me","after":{"1":[[1,2]]}}', "after must be"),
        (b'{"verb":"land","id":"a","issuer":"me","after":{"1":[[1,2,true]]}}', "after must be"),
        (order("land", "a", *[Place(1, 1, 1)] * 9), "after must be"),
        (order("land", "a"), "at which place"), (order("land", "a", Place(5, 0, 0)), "another companion"),
        (order("land", "a", Place(9, 1, 0)), "another flight"), (order("kill", "a", Place(9, 0, 0)), "confirmation"),
    ],
)  # fmt: skip
def test_a_command_out_of_all_order_is_refused(payload: bytes, why: str) -> None:
    agent = Agent(fleet(1), 1, boot_id=9)
    answer = json.loads(agent.receive_command(payload, Instant(1, 1)))
    assert not answer["accepted"]
    assert why in answer["reason"]
    assert answer["place"] == [9, 0, 0]


def test_of_the_places_given_one_must_be_this_companions() -> None:
    agent = Agent(fleet(1), 1, boot_id=9)
    both = order("release", "a", Place(5, 3, 8), Place(9, 0, 0))
    assert json.loads(agent.receive_command(both, Instant(1, 1)))["accepted"]


def test_no_motion_may_use_up_the_revisions_of_all_others() -> None:
    ls, _ = aloft(1)
    newest = ls.vehicles[1].agent.history.newest
    legs = (VelocityLeg(ZERO, 0.0),)
    motion = with_legs(newest, at_ns=ls.now.fleet_ns, issuer=0, legs=legs)
    tree = json.loads(encode_motion(motion))
    answer = said(ls, order("motion", "a", place(ls), motion={**tree, "revision": 2**32 - 1}))
    assert "ahead" in answer["reason"]
    assert said(ls, order("motion", "b", place(ls), motion=tree))["accepted"]


def test_a_motion_that_climbs_for_ever_or_begins_far_away_is_refused() -> None:
    ls, _ = aloft(1)
    newest = ls.vehicles[1].agent.history.newest
    up = with_legs(newest, at_ns=ls.now.fleet_ns, issuer=0, legs=(velocity_leg(0.0, 0.0, 0.5),))
    answer = said(ls, order("motion", "a", place(ls), motion=json.loads(encode_motion(up))))
    assert answer["reason"] == "it climbs or sinks for ever; give an altitude to go to"
    tree = json.loads(encode_motion(with_legs(newest, at_ns=ls.now.fleet_ns, issuer=0, legs=(VelocityLeg(ZERO, 0.0),))))
    tree["centre_ned_m"][0] += 150.0
    assert "out of range" in said(ls, order("motion", "b", place(ls), motion=tree))["reason"]


# -- rtl -------------------------------------------------------------------------------------------------------------


def test_six_vehicles_fly_back_over_their_own_pads_and_land_there() -> None:
    ls = launch(fleet(6, change=stay), seed=2)
    until_formed(ls)
    operator = Operator(ls.config, InLockstep(ls))
    assert operator.form("circle", ls.now.fleet_ns).all_accepted
    assert operator.move(velocity_leg(1.5, 0.5, 0.0), ls.now.fleet_ns).all_accepted
    wait(ls, 16.0)
    begun_s = ls.now_ns * 1e-9
    assert operator.rtl(ls.now.fleet_ns).all_accepted
    wait(ls, 3.0)
    assert ls.all_in(Phase.RETURNING)
    until_landed(ls, 90.0)
    t = truth(ls, begun_s)
    assert distances(t).min() >= 1.2
    for k, i in enumerate(t.ids):
        v = ls.config.by_id(i)
        assert np.hypot(*(t.position_ned_m[-1, k, :2] - (v.pad_north_m, v.pad_east_m))) < 1.0
    assert failsafes(ls) == []


def test_a_plan_that_ends_with_its_return_lands_every_vehicle_on_its_pad() -> None:
    def back(tables: dict[str, Any]) -> None:
        tables["plan"]["then"] = "return"

    ls = launch(fleet(3, legs=straight(6.0), change=back), seed=3)
    until_formed(ls)
    until_landed(ls, 90.0)
    for i, p in ls.positions().items():
        v = ls.config.by_id(i)
        assert np.hypot(p.north - v.pad_north_m, p.east - v.pad_east_m) < 1.0
    assert failsafes(ls) == []


def test_the_rest_form_without_whoever_never_comes_if_that_is_the_rule() -> None:
    def go_on(tables: dict[str, Any]) -> None:
        tables["peers"].update(wait_s=5.0, missing="continue")

    ls = launch(fleet(3, legs=straight(4.0), change=go_on), seed=3)
    ls.command(b'{"verb":"land"}', 2)
    until(ls, 60.0, lambda: {ls.phases()[i] for i in (1, 3)} == {Phase.MOVING})
    until(ls, 60.0, lambda: {ls.phases()[i] for i in (1, 3)} == {Phase.LANDED})
    assert {note for _, note in failsafes(ls)} <= {
        "failsafe: the others never come: waited for vehicle 2 in vain: continue",
    }  # fmt: skip


# -- release, resume, kill -------------------------------------------------------------------------------------------


def test_a_released_vehicle_hovers_without_setpoints_and_comes_back_on_command_without_a_jump() -> None:
    setpoints: list[tuple[float, bytes]] = []

    def record(i: int, channel: str, now: Instant, body: bytes) -> None:
        if i == 1 and channel == "output/mavlink" and body[7:10] == b"\x54\x00\x00":
            setpoints.append((now.monotonic_ns * 1e-9, body))

    ls = launch(fleet(3, change=stay), seed=2, record=record)
    until_formed(ls)
    operator = Operator(ls.config, InLockstep(ls))
    assert operator.move(velocity_leg(1.0, 0.0, 0.0), ls.now.fleet_ns).all_accepted
    wait(ls, 6.0)
    released_s = ls.now_ns * 1e-9
    assert operator.release(1).all_accepted
    wait(ls, 6.0)
    assert ls.phases() == {1: Phase.RELEASED, 2: Phase.MOVING, 3: Phase.MOVING}
    assert setpoints[-1][0] <= released_s + 0.01
    assert mode(ls, 1) == Px4Mode.AUTO_LOITER
    resumed_s = ls.now_ns * 1e-9
    assert operator.resume(1).all_accepted
    wait(ls, 2.0)
    assert ls.phases()[1] is Phase.DETACHED
    until(ls, 60.0, lambda: ls.phases()[1] is Phase.MOVING)
    t = truth(ls, released_s)
    assert distances(t).min() >= 1.2
    velocities = np.array([(m.vx, m.vy) for s, b in setpoints if s > resumed_s for m in [parse(b)]])
    assert np.linalg.norm(np.diff(velocities, axis=0), axis=1).max() < 0.6
    assert np.linalg.norm(velocities[0]) < 0.5
    assert failsafes(ls) == []


def test_a_companion_that_starts_in_flight_steers_only_on_command_and_comes_back() -> None:
    ls, operator = aloft(2)
    ls.kill(1)
    wait(ls, 1.5)
    assert mode(ls, 1) == Px4Mode.AUTO_LAND
    ls.restart(1)
    wait(ls, 1.2)
    assert ls.phases()[1] is Phase.IDLE
    assert operator.resume(1).all_accepted
    until(ls, 30.0, lambda: ls.phases()[1] is Phase.WAITING)
    assert mode(ls, 1) == Px4Mode.OFFBOARD
    assert operator.land().all_accepted
    until_landed(ls)


def test_a_resume_changes_nothing_for_whoever_is_steered_already_and_is_refused_in_the_landing() -> None:
    ls, operator = aloft(1)
    why = "to resume is for the released, and for those found in the air"
    assert operator.resume().all_accepted
    wait(ls, 0.5)
    assert ls.phases()[1] is Phase.WAITING
    assert operator.land().all_accepted
    assert operator.resume().refused == {1: f"it is landing: {why}"}


@pytest.mark.parametrize("verb", ["release", "land"])
def test_a_release_or_landing_during_a_resume_leaves_the_vehicle_in_hold_mode(verb: str) -> None:
    ls, operator = aloft(1)
    assert operator.release().all_accepted
    for ls.command_delay_s, reached in (
        (0.0, Px4Mode.AUTO_LOITER),  # OFFBOARD is not asked for yet
        (0.3, Px4Mode.AUTO_LOITER),  # it is on its way
        (0.0, Px4Mode.OFFBOARD),  # it is there, and the companion has not heard of it
    ):
        wait(ls, 3.0)
        assert operator.resume().all_accepted
        wait(ls, ls.command_delay_s)
        until_mode(ls, reached)
        assert ls.phases()[1] is Phase.RELEASED
        assert getattr(operator, verb)().refused == ({} if verb == "release" else {1: "the pilot has the vehicle"})
        setpoints = ls.vehicles[1].agent.setpoints_sent
        wait(ls, 2.0)
        assert ls.phases()[1] is Phase.RELEASED
        assert mode(ls, 1) == Px4Mode.AUTO_LOITER
        assert ls.vehicles[1].agent.setpoints_sent == setpoints


def test_a_companion_that_is_asked_to_end_during_a_resume_first_leaves_the_vehicle_in_hold_mode() -> None:
    ls, operator = aloft(1)
    agent = ls.vehicles[1].agent
    assert operator.release().all_accepted
    wait(ls, 3.0)
    assert operator.resume().all_accepted
    assert not agent.stopped
    until_mode(ls, Px4Mode.OFFBOARD)
    agent.stop(ls.now)
    assert not agent.stopped
    until(ls, 1.2, lambda: agent.stopped)
    ls.kill(1)
    wait(ls, 2.0)
    assert mode(ls, 1) == Px4Mode.AUTO_LOITER


def test_what_is_being_killed_is_not_resumed_and_a_kill_in_vain_does_not_fire_later(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    ls, operator = aloft(1)
    assert operator.release().all_accepted
    wait(ls, 3.0)
    with monkeypatch.context() as lost:
        lost.setattr(Lockstep, "_to_autopilot", lambda *_: None)
        assert operator.kill().all_accepted
        wait(ls, 1.0)
        assert operator.resume().refused == {1: "it is being killed"}
        assert not ls.vehicles[1].agent.stopped
        wait(ls, 9.2)
    assert operator.resume().all_accepted
    wait(ls, 5.0)
    assert ls.vehicles[1].autopilot.truth().armed
    assert ls.phases()[1] in (Phase.DETACHED, Phase.WAITING)


def test_on_the_ground_there_is_nothing_to_resume() -> None:
    ls = Lockstep(fleet(1))
    ls.run_until(5.0)
    assert said(ls, order("resume", "a", place(ls)))["reason"] == "it is not armed"


def test_a_killed_vehicle_falls_at_once_and_the_others_stay() -> None:
    ls, operator = aloft(2)
    assert not said(ls, order("kill", "a", place(ls)))["accepted"]
    assert operator.kill(1).all_accepted
    wait(ls, 0.2)
    assert not ls.vehicles[1].autopilot.truth().armed
    wait(ls, 2.5)
    assert ls.positions()[1].down > -0.2
    assert ls.phases() == {1: Phase.LANDED, 2: Phase.WAITING}


def test_one_vehicle_lands_while_the_others_stay() -> None:
    ls, operator = aloft(2)
    assert operator.land(2).all_accepted
    until(ls, 30.0, lambda: ls.phases()[2] is Phase.LANDED)
    assert ls.phases()[1] is Phase.WAITING
