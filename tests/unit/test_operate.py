"""The operator's verbs: what is sent to whom, and what is made of the answers."""

import json
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from math import inf, nan, pi, radians
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from statuses import FORMED

from companion.config import FleetConfig, load
from companion.core.frames import Ned
from companion.core.trajectory.fleet import FleetTrajectory
from companion.core.trajectory.legs import FreeLeg, GotoLeg, TurnLeg, VelocityLeg
from companion.core.trajectory.successors import over_the_pads, with_formation, with_legs
from companion.errors import ConfigError, RefusedError
from companion.operator.client import (
    COMMAND_LEAD_NS,
    Answers,
    Operator,
    PreflightError,
    turn_leg,
    velocity_leg,
)
from companion.operator.clocks import ROUNDS_LEAST
from companion.wire.operator import PLACES_MAX, Check, PreflightReport, Scare, decode_command, encode
from companion.wire.peer import decode_motion, encode_motion

CONFIG = load(Path(__file__).resolve().parents[2] / "fleet.toml", lambda t: t.update(vehicle=t["vehicle"][:4]))
NOW_NS = 1_700_000_100_000_000_000


def formed(config: FleetConfig = CONFIG) -> FleetTrajectory:
    return with_formation(
        config.first_motion, at_ns=NOW_NS - 20_000_000_000, issuer=3, shape="v", slots=config.slots("v"), pinned={},
        speed_m_s=2.0,
    )  # fmt: skip


def status(i: int, motion: FleetTrajectory, /, **more: object) -> dict[str, object]:
    """What a vehicle tells of itself, as JSON carries it."""
    return {
        **FORMED, "vehicle": i, "up_s": 100.0 + i, "place": [100 + i, 1, 4], "revision": motion.revision,
        "shape": motion.shape, "motion": json.loads(encode_motion(motion)), "messages": 7, **more,
    }  # fmt: skip


@dataclass
class Fleet:
    """Vehicles that hold given motions and answer as they are told to; a real Link without a network."""

    motions: dict[int, FleetTrajectory | None]
    """None: silent"""
    refusals: dict[int, str] = field(default_factory=dict)
    places: dict[int, list[int]] = field(default_factory=dict)
    """vehicle id -> where it is in the order of its commands, if not where its status says"""
    told: dict[int, dict[str, object]] = field(default_factory=dict)
    """vehicle id -> what its status says otherwise"""
    raw: dict[tuple[int, str], tuple[bytes, ...]] = field(default_factory=dict)
    """vehicle id and kind of question -> the bytes that answer it"""
    came: list[tuple[int, str, bytes]] = field(default_factory=list)
    checks: dict[int, tuple[Check, ...]] = field(default_factory=dict)
    """vehicle id -> the rows of its own preflight"""
    ahead_s: dict[int, float] = field(default_factory=dict)
    """vehicle id -> its clock against the operator's"""
    waited_s: float = 0.0
    found_late: tuple[int, ...] = ()
    """vehicles whose second companion the link finds while it waits"""

    def ask(
        self, vehicle_ids: Iterable[int], kind: str, payload: bytes, timeout_s: float, retry_s: float
    ) -> dict[int, tuple[bytes, ...]]:
        assert 0 < retry_s < timeout_s
        answers: dict[int, tuple[bytes, ...]] = {}
        for i in vehicle_ids:
            motion = self.motions[i]
            self.came.append((i, kind, payload))
            if (i, kind) in self.raw:
                answers[i] = self.raw[i, kind]
            elif motion is None:
                answers[i] = ()
            elif kind == "preflight":
                answers[i] = (self.account(i),)
            elif kind == "status":
                answers[i] = (json.dumps(status(i, motion, **self.told.get(i, {}))).encode(),)
            else:
                answers[i] = (json.dumps(self.answer(i, payload)).encode(),)
        return answers

    def wait(self, seconds: float) -> None:
        self.waited_s += seconds
        for i in self.found_late:
            twice(self, i)

    def answer(self, i: int, payload: bytes) -> dict[str, object]:
        here = self.places.get(i, [100 + i, 1, 4])
        in_order = here in json.loads(payload)["after"][str(i)]
        reason = self.refusals.get(i) if in_order else "not in order"
        answer = {"vehicle": i, "accepted": reason is None, "reason": reason, "phase": "formed", "revision": 1}
        return {**answer, "in_order": in_order, "place": here}

    def ask_timed(
        self, vehicle_ids: Iterable[int], kind: str, payload: bytes, timeout_s: float, retry_s: float
    ) -> dict[int, tuple[bytes, int, int] | None]:
        answers: dict[int, tuple[bytes, int, int] | None] = {}
        for i in vehicle_ids:
            self.came.append((i, kind, payload))
            there_ns = NOW_NS + round(self.ahead_s.get(i, 0.0) * 1e9) + 1_000_000
            reading = {"boot_id": 100 + i, "received_ns": there_ns, "answered_ns": there_ns}
            answers[i] = json.dumps(reading).encode(), NOW_NS, NOW_NS + 2_000_000
        return answers

    def account(self, i: int) -> bytes:
        vehicle = CONFIG.by_id(i)
        here = (vehicle.pad_north_m, vehicle.pad_east_m, 0.0)
        return encode(
            PreflightReport(
                vehicle=i, boot_id=100 + i, system_id=i, configuration=CONFIG.shared_hash,
                assignment=CONFIG.assignment_hash, flying=False, revision=0, position_ned_m=here, slot_ned_m=here,
                origin_ned_m=here, home_altitude_amsl_m=488.0, own_id_heard=False, checks=self.checks.get(i, ()),
            )
        )  # fmt: skip

    def commands(self) -> list[bytes]:
        return [payload for _, kind, payload in self.came if kind == "command"]

    def motion(self) -> FleetTrajectory:
        """The one motion that everybody was sent."""
        (payload,) = set(self.commands())
        command = json.loads(payload)
        assert command["verb"] == "motion"
        return decode_motion(json.dumps(command["motion"]).encode())


def fleet(newest: FleetTrajectory | None = None) -> Fleet:
    return Fleet({i: newest or formed() for i in range(1, 5)})


def test_every_vehicle_is_sent_the_same_bytes_and_all_accept() -> None:
    link = fleet()
    answers = Operator(CONFIG, link).take_off()
    assert answers.all_accepted
    assert [i for i, kind, _ in link.came if kind == "command"] == [1, 2, 3, 4]
    assert {json.loads(p)["verb"] for p in link.commands()} == {"takeoff"}
    assert len(set(link.commands())) == 1


def test_nobody_is_told_to_take_off_unless_the_whole_fleet_is_fit() -> None:
    link = fleet()
    link.motions[4] = None
    link.ahead_s[3] = 0.4
    link.checks[2] = (Check("GF_ACTION", 4, "0 or 1", False, "GF_ACTION is 4", permanent=True, vehicle=2),)
    with pytest.raises(PreflightError) as refused:
        Operator(CONFIG, link).take_off()
    assert link.commands() == []
    told = str(refused.value).splitlines()
    assert told == [
        "not fit for take-off:", "  not heard: vehicle 4", "  vehicle 2: GF_ACTION is 4",
        "  vehicle 3: its clock is 0.400 s from vehicle 1, 2's, may be 0.1 s",
    ]  # fmt: skip
    assert refused.value.report.permanent


def test_a_fit_fleet_is_asked_for_its_clocks_a_few_times() -> None:
    link = fleet()
    assert Operator(CONFIG, link).preflight().fit
    assert len([p for i, kind, p in link.came if i == 1 and p == b"clock"]) == ROUNDS_LEAST


def test_refusals_and_silence_are_told_by_vehicle() -> None:
    link = fleet()
    link.motions[4] = None
    link.refusals[2] = "no heartbeat from the autopilot"
    answers = Operator(CONFIG, link).land()
    assert answers == Answers((1, 3), {2: "no heartbeat from the autopilot"}, (4,))
    assert not answers.all_accepted
    sentence = "land: accepted by 2; vehicle 2 refused: no heartbeat from the autopilot; silent: vehicle 4"
    assert answers.sentence("land") == sentence


def test_status_keeps_the_silent_apart() -> None:
    link = fleet()
    link.motions[1] = None
    status = Operator(CONFIG, link).status()
    assert status[1] is None
    assert status[2] is not None
    assert status[2].vehicle == 2


def test_a_new_formation_follows_the_newest_motion_that_anyone_holds() -> None:
    newest = formed()
    newer = with_legs(newest, at_ns=NOW_NS - 1, issuer=4, legs=(VelocityLeg(Ned(1.0, 0.0, 0.0), 60.0),))
    link = fleet(newest)
    link.motions[3] = newer
    assert Operator(CONFIG, link).form("line", NOW_NS).all_accepted
    motion = link.motion()
    assert (motion.revision, motion.issuer, motion.shape) == (newer.revision + 1, 0, "line")
    assert motion.start_ns == NOW_NS + COMMAND_LEAD_NS
    assert motion.legs == newer.legs
    for i in range(1, 5):
        before, after = newer.reference(i, motion.start_ns), motion.reference(i, motion.start_ns)
        assert before.position_ned_m == pytest.approx(after.position_ned_m, abs=1e-9)


def test_a_command_never_starts_before_the_motion_that_it_follows() -> None:
    ahead = with_legs(formed(), at_ns=NOW_NS + 60_000_000_000, issuer=1, legs=())
    link = fleet(ahead)
    Operator(CONFIG, link).hold(lambda: NOW_NS)
    assert link.motion().start_ns == ahead.start_ns + 1


def test_hold_stops_the_centre_and_move_sends_it_on() -> None:
    moving = with_legs(formed(), at_ns=NOW_NS - 10_000_000_000, issuer=1, legs=(VelocityLeg(Ned(1.0, 0.0, 0.0), 60.0),))
    link = fleet(moving)
    Operator(CONFIG, link).hold(lambda: NOW_NS)
    held = link.motion()
    late = held.state_at(NOW_NS + 30_000_000_000).centre
    assert late.velocity == (0.0, 0.0, 0.0)
    link = fleet(held)
    Operator(CONFIG, link).move(velocity_leg(0.0, 1.0, 0.0), NOW_NS)
    assert link.motion().state_at(NOW_NS + 60_000_000_000).centre.velocity == pytest.approx((0.0, 1.0, 0.0))


def drifting() -> Fleet:
    """Without a shared motion, 30 m away from where that began, by what three say; one is far off, none is silent."""
    link = fleet(with_legs(formed(), at_ns=NOW_NS - 10_000_000_000, issuer=1, legs=(FreeLeg(),)))
    for i, (north, speed) in enumerate(((29.9, 0.5), (30.1, 0.5), (30.0, 0.5), (90.0, 3.0)), 1):
        link.told[i] = {"centre": [NOW_NS, [north, 0.0, -10.0], [speed, 0.0, 0.0]]}
    return link


def test_a_shared_motion_begins_where_most_say_that_the_fleet_is() -> None:
    link = drifting()
    Operator(CONFIG, link).hold(lambda: NOW_NS)
    motion = link.motion()
    assert motion.free_from_ns is None
    begun = motion.state_at(motion.start_ns).centre
    assert begun.position == pytest.approx(Ned(30.05 + 1.0, 0.0, -10.0), abs=0.01)
    assert begun.velocity == pytest.approx(Ned(0.5, 0.0, 0.0))


def test_another_formation_leaves_a_free_fleet_free_and_a_shared_motion_can_be_freed() -> None:
    link = drifting()
    Operator(CONFIG, link).form("line", NOW_NS)
    assert link.motion().free_from_ns is not None
    assert link.motion().shape == "line"
    link = fleet()
    Operator(CONFIG, link).free(NOW_NS)
    assert link.motion().free_from_ns is not None


def test_nobody_commands_a_shared_motion_where_nobody_says_where_the_fleet_is() -> None:
    link = drifting()
    link.told.clear()
    with pytest.raises(RefusedError, match="no vehicle says where the formation is"):
        Operator(CONFIG, link).hold(lambda: NOW_NS)


def test_a_wish_is_told_to_those_named_alone() -> None:
    link = drifting()
    answers = Operator(CONFIG, link).wish(velocity_leg(1.0, 0.0, 0.0), [3, 1])
    assert answers.accepted == (1, 3)
    told = {i: json.loads(payload) for i, kind, payload in link.came if kind == "command"}
    assert sorted(told) == [1, 3]
    assert told[1]["verb"] == "wish"
    assert told[1]["leg"] == {"kind": "velocity", "velocity_ned_m_s": [1.0, 0.0, 0.0], "duration_s": 0.0}


THREAT = Scare(begins_ns=NOW_NS, north_m=-20.0, east_m=0.0, north_m_s=5.0, radius_m=8.0, lasts_s=10.0)


def test_all_are_told_of_a_threat_where_no_motion_is_shared() -> None:
    link = drifting()
    assert Operator(CONFIG, link).scare(THREAT, NOW_NS).accepted == (1, 2, 3, 4)
    told = {i: decode_command(payload) for i, kind, payload in link.came if kind == "command"}
    assert {i: c.threat for i, c in told.items()} == dict.fromkeys(range(1, 5), THREAT)


def test_nobody_is_told_of_a_threat_where_a_motion_is_shared_or_nobody_answers() -> None:
    link = fleet()
    with pytest.raises(RefusedError, match="only a free one flees: move --free first"):
        Operator(CONFIG, link).scare(THREAT, NOW_NS)
    assert not [kind for _, kind, _ in link.came if kind == "command"]
    link.motions = dict.fromkeys(link.motions, None)
    with pytest.raises(RefusedError, match="no vehicle answers"):
        Operator(CONFIG, link).scare(THREAT, NOW_NS)


def test_goto_flies_the_centre_to_the_point_and_stops_there() -> None:
    link = fleet()
    Operator(CONFIG, link).goto(30.0, 40.0, None, 1.0, NOW_NS)
    motion = link.motion()
    (leg,) = motion.legs
    assert isinstance(leg, GotoLeg)
    assert leg.duration_s == pytest.approx(1.875 * 50.0, rel=0.01)
    end = motion.state_at((motion.end_ns or 0) + 1).centre
    assert end.position == pytest.approx((30.0, 40.0, -10.0))
    assert end.velocity == pytest.approx((0.0, 0.0, 0.0))
    link = fleet()
    Operator(CONFIG, link).goto(0.0, 0.0, 15.0, 1.0, NOW_NS)
    (leg,) = link.motion().legs
    assert isinstance(leg, GotoLeg)
    assert leg.target_ned_m.down == -15.0


def test_legs_of_the_command_line() -> None:
    assert velocity_leg(1.0, 2.0, 0.5) == VelocityLeg(Ned(1.0, 2.0, -0.5), 0.0)
    assert turn_leg(6.0, 90.0) == TurnLeg(radians(6.0), 90.0 * pi / 180.0)
    assert turn_leg(-6.0, None) == TurnLeg(radians(-6.0), inf)


def test_nothing_is_commanded_when_nobody_says_where_the_fleet_is() -> None:
    link = Fleet(dict.fromkeys(range(1, 5)))
    with pytest.raises(RefusedError, match="no vehicle answers"):
        Operator(CONFIG, link).hold(lambda: NOW_NS)
    assert link.commands() == []


def test_an_unknown_shape_is_refused_before_anybody_is_asked() -> None:
    link = fleet()
    with pytest.raises(ConfigError, match="must be one of v, line"):
        Operator(CONFIG, link).form("star", NOW_NS)
    assert link.came == []


def test_before_the_fleet_has_formed_by_itself_no_motion_takes_the_place_of_forming() -> None:
    link = fleet(CONFIG.first_motion)
    operator = Operator(CONFIG, link)
    acts: list[Callable[[], Answers]] = [
        lambda: operator.form("line", NOW_NS),
        lambda: operator.hold(lambda: NOW_NS),
        lambda: operator.move(velocity_leg(1.0, 0.0, 0.0), NOW_NS),
        lambda: operator.goto(1.0, 1.0, None, 1.0, NOW_NS),
    ]
    for act in acts:
        with pytest.raises(RefusedError, match="not in formation yet"):
            act()
    assert link.commands() == []


def test_a_fleet_that_waits_for_its_operator_is_formed_by_him() -> None:
    config = CONFIG.model_copy(update={"plan": CONFIG.plan.model_copy(update={"automatic": False})})
    link = fleet(config.first_motion)
    assert Operator(config, link).form("line", NOW_NS).all_accepted
    assert link.motion().revision == 1


Act = Callable[[Operator], Answers]
MOTIONS: list[Act] = [
    lambda o: o.hold(lambda: NOW_NS), lambda o: o.rtl(NOW_NS), lambda o: o.form("line", NOW_NS),
    lambda o: o.move(velocity_leg(1.0, 0.0, 0.0), NOW_NS), lambda o: o.goto(5.0, 5.0, None, 1.0, NOW_NS),
]  # fmt: skip


@pytest.mark.parametrize("act", MOTIONS)
@pytest.mark.parametrize(
    "answer",
    [
        b"", b"null", b"[]", b"{}", b"\xff", b"[" * 100_000, b'{"vehicle":2}', b"1" * 5000,
        json.dumps({k: v for k, v in status(2, CONFIG.first_motion).items() if k != "motion"}).encode(),
        json.dumps(status(2, CONFIG.first_motion, motion={"version": 9})).encode(),
        json.dumps(status(2, CONFIG.first_motion, motion=None)).encode(),
        json.dumps(status(2, CONFIG.first_motion, nearest_m=nan)).encode(),
        json.dumps(status(2, CONFIG.first_motion)).encode().replace(b'"messages": 7', b'"messages": ' + b"9" * 5000),
        json.dumps(status(3, CONFIG.first_motion)).encode(),
        json.dumps(status(2, replace(formed(), revision=2**32 - 1))).encode(),
        json.dumps(status(2, replace(formed(), revision=10_002))).encode(),
        json.dumps(status(2, replace(formed(), revision=2, start_ns=2**62))).encode(),
    ],
)  # fmt: skip
def test_one_vehicle_that_answers_nonsense_is_named_and_keeps_no_motion_from_the_others(
    act: Act, answer: bytes
) -> None:
    link = fleet()
    link.raw[2, "status"] = (answer,)
    answers = act(Operator(CONFIG, link))
    assert {1, 3, 4} <= set(answers.accepted)
    assert "vehicle 2's" in answers.sentence("hold")
    assert {json.loads(p)["motion"]["revision"] for p in link.commands()} == {2}


def test_a_late_companion_is_no_measure_of_how_far_the_others_are() -> None:
    link = fleet(replace(formed(), revision=20_000))
    link.motions[1] = link.motions[4] = CONFIG.first_motion
    assert Operator(CONFIG, link).hold(lambda: NOW_NS).all_accepted
    assert link.motion().revision == 20_001


def test_revisions_that_are_used_up_are_told() -> None:
    with pytest.raises(RefusedError, match="used up"):
        Operator(CONFIG, fleet(replace(formed(), revision=2**32 - 1))).hold(lambda: NOW_NS)


@pytest.mark.parametrize("answer", [b"", b"{}", b'{"vehicle":' + b"9" * 5000 + b"}", b"\xff"])
def test_a_preflight_answer_that_cannot_be_read_is_a_fault_of_that_vehicle(answer: bytes) -> None:
    link = fleet()
    link.raw[2, "preflight"] = (answer,)
    faults = Operator(CONFIG, link).preflight().faults
    assert len(faults) == 1
    assert faults[0].startswith("vehicle 2: its answer cannot be read")


@settings(deadline=None)
@given(st.dictionaries(st.sampled_from(sorted(status(2, formed()))), st.none() | st.integers() | st.floats()
       | st.text(max_size=5) | st.lists(st.integers(), max_size=3), max_size=4))  # fmt: skip
def test_no_status_of_one_vehicle_keeps_a_landing_or_a_hold_from_the_others(wrong: dict[str, object]) -> None:
    link = fleet()
    link.told[2] = wrong
    assert {1, 3, 4} <= set(Operator(CONFIG, link).land().accepted)
    assert {1, 3, 4} <= set(Operator(CONFIG, link).hold(lambda: NOW_NS).accepted)


# -- which flight ------------------------------------------------------------------------------------------------------


def twice(link: Fleet, i: int) -> None:
    """Two companions answer as this vehicle."""
    one, two = (status(i, formed(), place=[boot, 1, 4], up_s=up) for boot, up in ((100 + i, 12.0), (7, 340.0)))
    link.raw[i, "status"] = (json.dumps(one).encode(), json.dumps(two).encode())


@pytest.mark.parametrize("act", [*MOTIONS, lambda o: o.land(), lambda o: o.kill(), lambda o: o.release(),
                                 lambda o: o.resume(), lambda o: o.take_off()])  # fmt: skip
def test_where_two_companions_answer_as_one_vehicle_nobody_is_commanded(act: Act) -> None:
    link = fleet()
    twice(link, 3)
    with pytest.raises(RefusedError, match="vehicle 3 is two companions, one up for 12 s and one up for 340 s"):
        act(Operator(CONFIG, link))
    assert link.commands() == []


def test_one_forged_put_under_a_vehicles_id_keeps_no_command_from_the_fleet() -> None:
    link = fleet()
    link.told[3] = {"own_id_heard": True}
    assert Operator(CONFIG, link).land().all_accepted
    assert link.waited_s == pytest.approx(1.0)
    assert Operator(CONFIG, link).kill().all_accepted
    assert link.waited_s == pytest.approx(1.5)


def test_a_second_companion_that_is_found_late_is_one_of_two() -> None:
    link = fleet()
    link.told[3] = {"own_id_heard": True}
    link.found_late = (3,)
    with pytest.raises(RefusedError, match="vehicle 3 is two companions"):
        Operator(CONFIG, link).land()
    assert link.commands() == []


def test_what_ends_a_flight_reaches_both_if_that_is_wanted() -> None:
    link = fleet()
    twice(link, 3)
    operator = Operator(CONFIG, link, both=True)
    assert operator.land().all_accepted
    (order,) = {json.dumps(json.loads(p)["after"]["3"]) for p in link.commands()}
    assert json.loads(order) == [[103, 1, 4], [7, 1, 4]]
    with pytest.raises(RefusedError, match="two companions"):
        operator.resume()
    assert Operator(CONFIG, link).land(2).accepted == (2,), "the others are no trouble of vehicle 2's"


def test_a_second_companion_that_shows_only_in_the_answers_is_told() -> None:
    link = fleet()
    here = json.dumps({"vehicle": 3, "accepted": True, "reason": None, "place": [103, 1, 4]}).encode()
    other = {"vehicle": 3, "accepted": False, "reason": "it is for another companion", "in_order": False}
    link.raw[3, "command"] = (here, json.dumps({**other, "place": [7, 1, 4]}).encode())
    answers = Operator(CONFIG, link).resume()
    assert answers.refused == {3: "two companions answer as this vehicle: it is for another companion"}


@pytest.mark.parametrize("answer", [b"{}", b"[]", b'{"vehicle":3,"accepted":1,"reason":null}', b"[" * 100_000])
def test_an_answer_that_cannot_be_read_is_none_and_is_named(answer: bytes) -> None:
    link = fleet()
    link.raw[3, "command"] = (answer,)
    answers = Operator(CONFIG, link).land()
    assert answers.accepted == (1, 2, 4)
    assert answers.silent == (3,)
    assert "vehicle 3's answer cannot be read: " in answers.sentence("land")


def test_a_vehicle_that_answers_as_ever_new_companions_spoils_no_command_to_the_others() -> None:
    link = fleet()
    link.raw[3, "status"] = tuple(
        json.dumps(status(3, formed(), place=[boot, 1, 4])).encode() for boot in range(1, 2 * PLACES_MAX)
    )
    link.raw[3, "command"] = (b'{"vehicle":3,"accepted":false,"reason":"no","in_order":false,"place":[99,1,4]}',)
    answers = Operator(CONFIG, link, both=True).land()
    assert answers.accepted == (1, 2, 4)
    assert all(len(decode_command(p).after.get(3, ())) <= PLACES_MAX for p in link.commands())


def test_a_verb_tells_which_flight_it_reached() -> None:
    link = fleet()
    operator = Operator(CONFIG, link)
    assert operator.roster.reached == "fleet starling: nobody"
    operator.land()
    assert operator.roster.reached == "fleet starling, companions up for 104 s"
    link.told[2] = {"up_s": 3.0}
    operator.land()
    assert operator.roster.reached == "fleet starling, companions up for 3 to 104 s"


def test_a_climb_for_ever_is_not_sent() -> None:
    link = fleet()
    with pytest.raises(RefusedError, match="climb or sink for ever"):
        Operator(CONFIG, link).move(velocity_leg(0.0, 0.0, 0.5), NOW_NS)
    assert link.commands() == []


def test_a_command_names_the_place_at_which_each_vehicle_said_to_be() -> None:
    link = fleet()
    link.told[3] = {"place": [5, 6, 7]}
    link.places[3] = [5, 6, 7]
    operator = Operator(CONFIG, link, issuer="me")
    assert operator.land().all_accepted
    order = json.loads(link.commands()[0])
    assert order["after"] == {"1": [[101, 1, 4]], "2": [[102, 1, 4]], "3": [[5, 6, 7]], "4": [[104, 1, 4]]}
    assert order["issuer"] == "me"
    operator.land()
    assert len({json.loads(p)["id"] for p in link.commands()}) == 2, "two commands alike are two"


def test_only_what_ends_a_flight_is_commanded_again_to_whoever_has_gone_on_and_to_the_silent() -> None:
    link = fleet()
    operator = Operator(CONFIG, link, issuer="me")
    operator.status()
    link.places[3] = [103, 2, 9]
    link.refusals[2] = "it is on the ground"
    link.motions[4] = None
    assert operator.command("resume").outdated == (3,)
    assert len(link.commands()) == 4
    link.came.clear()
    operator = Operator(CONFIG, link, issuer="me")
    operator.status()
    link.came.clear()
    answers = operator.command("kill", confirm=True)
    again = [i for i, _, _ in link.came]
    assert again == [1, 2, 3, 4, 3, 4, 4, 4], "whoever was elsewhere, and the silent"
    assert answers == Answers((1, 3), {2: "it is on the ground"}, (4,))


def test_whoever_was_not_heard_before_a_command_is_commanded_once_more() -> None:
    link = fleet()
    assert Operator(CONFIG, link).command("resume").all_accepted
    assert len(link.commands()) == 8


def test_two_operators_are_two_issuers() -> None:
    assert Operator(CONFIG, fleet()).issuer != Operator(CONFIG, fleet()).issuer


@pytest.mark.parametrize("verb", ["land", "release", "resume", "kill"])
def test_a_verb_for_one_vehicle_reaches_that_one_alone(verb: str) -> None:
    link = fleet()
    assert getattr(Operator(CONFIG, link), verb)(2).accepted == (2,)
    assert [i for i, kind, _ in link.came if kind == "command"] == [2]
    (order,) = (json.loads(p) for p in link.commands())
    assert order.get("confirm") is (True if verb == "kill" else None)
    with pytest.raises(ConfigError, match="vehicle 9"):
        getattr(Operator(CONFIG, link), verb)(9)


def test_rtl_brings_every_vehicle_over_its_own_pad() -> None:
    moving = with_legs(
        formed(), at_ns=NOW_NS - 10_000_000_000, issuer=1, legs=(TurnLeg(radians(6.0), inf),),
        heading_follows_turns=True,
    )  # fmt: skip
    moving = with_legs(
        with_legs(moving, at_ns=NOW_NS - 9_000_000_000, issuer=1, legs=(VelocityLeg(Ned(1.0, 0.0, 0.0), 0.0),)),
        at_ns=NOW_NS - 4_000_000_000, issuer=1, legs=(TurnLeg(radians(6.0), inf),),
    )  # fmt: skip
    link = fleet(moving)
    assert Operator(CONFIG, link).rtl(NOW_NS).all_accepted
    motion = link.motion()
    assert motion.returns
    assert motion.end_ns is not None
    home = CONFIG.first_motion
    for i in motion.slots:
        end = motion.reference(i, motion.end_ns)
        assert end.position_ned_m == pytest.approx(home.reference(i, 0).position_ned_m, abs=1e-3)
        assert end.velocity_ned_m_s == pytest.approx((0.0, 0.0, 0.0), abs=1e-6)
        start, before = (m.reference(i, motion.start_ns) for m in (motion, moving))
        assert start.position_ned_m == pytest.approx(before.position_ned_m, abs=1e-6)
        assert start.velocity_ned_m_s == pytest.approx(before.velocity_ned_m_s, abs=1e-6)
    assert over_the_pads(motion, home)
    shifted = replace(motion, legs=(GotoLeg(Ned(5.0, 0.0, -10.0), 20.0),))
    assert not over_the_pads(shifted, home)
    swapped = replace(motion, slots={**motion.slots, 1: motion.slots[2], 2: motion.slots[1]})
    assert not over_the_pads(swapped, home)
