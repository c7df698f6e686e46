"""The operator's verbs: what is sent to whom, and what is made of the answers."""

import json
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from math import inf, pi, radians
from pathlib import Path

import pytest

from companion.config import FleetConfig, load
from companion.core.frames import Ned
from companion.core.plan import GotoLeg, Motion, TurnLeg, VelocityLeg, over_the_pads, with_formation, with_legs
from companion.errors import ConfigError, RefusedError
from companion.operate import (
    CLOCK_ROUNDS_LEAST,
    COMMAND_LEAD_NS,
    Answers,
    Operator,
    PreflightError,
    turn_leg,
    velocity_leg,
)
from companion.preflight import Account, Check, assignment_hash
from companion.wire.peer import decode_motion, encode_motion

CONFIG = load(Path(__file__).resolve().parents[2] / "fleet.toml", lambda t: t.update(vehicle=t["vehicle"][:4]))
NOW_NS = 1_700_000_100_000_000_000


def formed(config: FleetConfig = CONFIG) -> Motion:
    return with_formation(
        config.first_motion, at_ns=NOW_NS - 20_000_000_000, issuer=3, shape="v", slots=config.slots("v"), pinned={},
        speed_m_s=2.0,
    )  # fmt: skip


@dataclass
class Fleet:
    """Vehicles that hold given motions and answer as they are told to; a real Link without a network."""

    motions: dict[int, Motion | None]
    """None: silent"""
    refusals: dict[int, str] = field(default_factory=dict)
    obeyed: dict[int, list[object]] = field(default_factory=dict)
    came: list[tuple[int, str, bytes]] = field(default_factory=list)
    checks: dict[int, tuple[Check, ...]] = field(default_factory=dict)
    """vehicle id -> the rows of its own preflight"""
    ahead_s: dict[int, float] = field(default_factory=dict)
    """vehicle id -> its clock against the operator's"""

    def ask(
        self, vehicle_ids: Iterable[int], kind: str, payload: bytes, timeout_s: float, retry_s: float
    ) -> dict[int, bytes | None]:
        assert 0 < retry_s < timeout_s
        answers: dict[int, bytes | None] = {}
        for i in vehicle_ids:
            motion = self.motions[i]
            self.came.append((i, kind, payload))
            if motion is None:
                answers[i] = None
            elif kind == "preflight":
                answers[i] = self.account(i)
            elif kind == "status":
                told = {"vehicle": i, "motion": json.loads(encode_motion(motion)), "command": self.obeyed.get(i)}
                answers[i] = json.dumps(told).encode()
            else:
                reason = self.refusals.get(i)
                told = {"vehicle": i, "accepted": reason is None, "reason": reason, "command": self.obeyed.get(i)}
                answers[i] = json.dumps(told).encode()
        return answers

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
        return Account(
            vehicle=i, boot_id=100 + i, system_id=i, configuration=CONFIG.shared_hash,
            assignment=assignment_hash(CONFIG), flying=False, revision=0, position_ned_m=here, slot_ned_m=here,
            origin_ned_m=here, home_altitude_amsl_m=488.0, checks=self.checks.get(i, ()),
        ).model_dump_json().encode()  # fmt: skip

    def commands(self) -> list[bytes]:
        return [payload for _, kind, payload in self.came if kind == "command"]

    def motion(self) -> Motion:
        """The one motion that everybody was sent."""
        (payload,) = set(self.commands())
        command = json.loads(payload)
        assert command["verb"] == "motion"
        return decode_motion(json.dumps(command["motion"]).encode())


def fleet(newest: Motion | None = None) -> Fleet:
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
    link.checks[2] = (Check("GF_ACTION", 4, "0 or 1", False, "GF_ACTION is 4", lasting=True, vehicle=2),)
    with pytest.raises(PreflightError) as refused:
        Operator(CONFIG, link).take_off()
    assert link.commands() == []
    told = str(refused.value).splitlines()
    assert told == [
        "not fit for take-off:", "  not heard: vehicle 4", "  vehicle 2: GF_ACTION is 4",
        "  vehicle 3: its clock is 0.400 s from vehicle 1, 2's, may be 0.1 s",
    ]  # fmt: skip
    assert refused.value.report.lasting


def test_a_fit_fleet_is_asked_for_its_clocks_a_few_times() -> None:
    link = fleet()
    assert Operator(CONFIG, link).preflight().fit
    assert len([p for i, kind, p in link.came if i == 1 and p == b"clock"]) == CLOCK_ROUNDS_LEAST


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
    assert status[2]["vehicle"] == 2


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
    late = held.moment(NOW_NS + 30_000_000_000).centre
    assert late.velocity == (0.0, 0.0, 0.0)
    link = fleet(held)
    Operator(CONFIG, link).move(velocity_leg(0.0, 1.0, 0.0), NOW_NS)
    assert link.motion().moment(NOW_NS + 60_000_000_000).centre.velocity == pytest.approx((0.0, 1.0, 0.0))


def test_goto_flies_the_centre_to_the_point_and_stops_there() -> None:
    link = fleet()
    Operator(CONFIG, link).goto(30.0, 40.0, None, 1.0, NOW_NS)
    motion = link.motion()
    (leg,) = motion.legs
    assert isinstance(leg, GotoLeg)
    assert leg.duration_s == pytest.approx(1.875 * 50.0, rel=0.01)
    end = motion.moment((motion.end_ns or 0) + 1).centre
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


def test_a_vehicle_whose_plan_cannot_be_read_is_named() -> None:
    class Strange(Fleet):
        def ask(
            self, vehicle_ids: Iterable[int], kind: str, payload: bytes, timeout_s: float, retry_s: float
        ) -> dict[int, bytes | None]:
            return {i: json.dumps({"vehicle": i, "motion": {"version": 9}}).encode() for i in vehicle_ids}

    with pytest.raises(RefusedError, match="vehicle 1 tells a plan that cannot be read"):
        Operator(CONFIG, Strange({})).hold(lambda: NOW_NS)


def test_a_climb_for_ever_is_not_sent() -> None:
    link = fleet()
    with pytest.raises(RefusedError, match="climb or sink for ever"):
        Operator(CONFIG, link).move(velocity_leg(0.0, 0.0, 0.5), NOW_NS)
    assert link.commands() == []


def test_a_command_is_newer_than_the_last_that_any_vehicle_obeyed_and_than_ones_own() -> None:
    link = fleet()
    link.obeyed[3] = [41, "somebody"]
    operator = Operator(CONFIG, link, issuer="me")
    operator.land()
    operator.land()
    orders = [json.loads(p) for p in link.commands()]
    assert [(o["revision"], o["issuer"]) for o in orders] == [(42, "me")] * 4 + [(43, "me")] * 4


def test_only_what_ends_a_flight_is_commanded_again_above_a_newer_command() -> None:
    link = fleet()
    link.obeyed[3] = [41, "somebody"]
    link.refusals[3] = "not newer"
    link.refusals[2] = "it is on the ground"
    link.motions[4] = None
    operator = Operator(CONFIG, link, issuer="me")
    assert operator.command("resume").outdated == (3,)
    assert [json.loads(p)["revision"] for p in link.commands()] == [1] * 4
    link.came.clear()
    operator = Operator(CONFIG, link, issuer="me")
    answers = operator.command("kill", confirm=True)
    again = [(i, json.loads(p)["revision"]) for i, _, p in link.came[4:]]
    assert again == [(3, 42), (4, 42), (4, 43), (4, 44)], "whoever has a newer one, and the silent"
    assert answers == Answers((1,), {2: "it is on the ground", 3: "not newer"}, (4,))


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
