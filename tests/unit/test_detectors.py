"""Each detector by itself: just before its limit it finds nothing, just after it does, and once."""

import pytest
from toy_autopilot import CONFIG, STABLE, at, fleet, flight, said

from companion.core.failsafe import (
    BATTERY_S,
    CLIMB_S,
    CREEP_LIMIT_M,
    FAILSAFES,
    HEARTBEAT_S,
    JUMPS_S,
    LOST_S,
    NOT_FOLLOWED_S,
    TAKE_OFF_S,
    UNCERTAIN_S,
    Action,
    NoticedBy,
)
from companion.core.frames import Ned
from companion.core.values import FILTERED_PHASES, FLYING_PHASES, ZERO, Instant, PeerMessage, PeerSample, Phase
from companion.vehicle.autopilot.port import HOLD, LAND, OFFBOARD, TAKE_OFF, Estimate, FlightMode, Outcome, Verb
from companion.vehicle.detectors import DETECTORS, Detector, Finding, Note
from companion.vehicle.detectors.autopilot import (
    STOPPED_LOW_S,
    AltitudeNotReached,
    HeartbeatLost,
    LeftByAutopilot,
    LeftByPilot,
    NoTakeOff,
    NotArmed,
    NotFollowed,
)
from companion.vehicle.detectors.battery import BatteryCritical, BatteryLow, BatteryUnknown
from companion.vehicle.detectors.peers import Alone, AloneForLong, Deaf, DetachedForLong, OthersMissing
from companion.vehicle.detectors.position import (
    PositionFrozen,
    PositionJumped,
    PositionJumpsOn,
    PositionLost,
    PositionStale,
    PositionUncertain,
)
from companion.vehicle.flight import Flight

JUST = 0.001


def looks(detector: Detector, one: Flight, seconds: float) -> Finding | Note | None:
    return detector.look(one, at(seconds))


def found_after(detector: Detector, one: Flight, limit_s: float) -> bool:
    """Whether it finds nothing from 0 s until just before the limit, and something just after."""
    before = [looks(detector, one, s) for s in (0.0, limit_s / 2, limit_s - JUST)]
    return before == [None] * 3 and looks(detector, one, limit_s + JUST) is not None


# -- the table is what acts --------------------------------------------------------------------------------------------


def test_each_row_has_exactly_one_detector_or_says_who_else_notices_it() -> None:
    detected = [kind.failsafe for kind in DETECTORS]
    assert len(detected) == len(set(detected))
    assert set(detected) == {f for f, row in FAILSAFES.items() if row.by is NoticedBy.DETECTOR}


@pytest.mark.parametrize("kind", DETECTORS)
def test_a_detector_that_is_not_asked_on_the_ground_finds_nothing_in_a_quiet_flight(kind: type[Detector]) -> None:
    for phase in sorted(kind.phases & FILTERED_PHASES):
        one, detector = flight(phase, armed=True, mode=OFFBOARD, on_ground=False), kind()
        for k in range(200):
            now = at(0.02 * k)
            said(one).lives(now)
            one.observe(now, positioned=True)
            assert detector.look(one, now) is None


# -- what was asked for ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("speed_max_m_s", "limit_m_s"), [(1.0, 2.0), (4.0, 2.0), (10.0, 5.0)])
def test_setpoints_are_not_followed_beyond_the_limit_for_its_time(speed_max_m_s: float, limit_m_s: float) -> None:
    limits = CONFIG.limits.model_copy(update={"speed_max_m_s": speed_max_m_s})
    one = flight(Phase.MOVING, armed=True, mode=OFFBOARD, on_ground=False)
    one.config = CONFIG.model_copy(update={"limits": limits})
    for off_m_s, acts in ((0.0, False), (limit_m_s, False), (limit_m_s + JUST, True), (100.0, True)):
        one.unfollowed_m_s = off_m_s
        assert found_after(NotFollowed(), one, NOT_FOLLOWED_S) is acts


def test_a_tick_that_is_followed_or_asks_for_nothing_begins_the_time_anew() -> None:
    one, detector = flight(Phase.MOVING, armed=True, mode=OFFBOARD, on_ground=False), NotFollowed()
    for second in range(10):
        one.unfollowed_m_s = 9.0
        assert looks(detector, one, second) is None
        assert looks(detector, one, second + 0.9) is None
        one.unfollowed_m_s = 0.0
        assert looks(detector, one, second + 0.95) is None


# -- the autopilot -----------------------------------------------------------------------------------------------------


def test_a_heartbeat_is_lost_after_its_limit_and_one_that_never_came_is_not() -> None:
    one = flight(Phase.LANDING)
    assert looks(HeartbeatLost(), one, 100.0) is None
    said(one).lives(at(0.0))
    assert found_after(HeartbeatLost(), one, HEARTBEAT_S)


@pytest.mark.parametrize(
    ("phase", "foreign", "ours"),
    [
        (Phase.ARMED, [LAND, FlightMode("RETURN")], [STABLE, HOLD, TAKE_OFF, OFFBOARD]),
        (Phase.CLIMBING, [LAND, STABLE], [HOLD, TAKE_OFF, OFFBOARD]),
        (Phase.LANDING, [FlightMode("RETURN")], [STABLE, HOLD, TAKE_OFF, OFFBOARD, LAND]),
        *((phase, [STABLE, HOLD, LAND, TAKE_OFF], [OFFBOARD]) for phase in sorted(FILTERED_PHASES)),
    ],
)
def test_a_mode_is_somebody_elses_in_its_phase(phase: Phase, foreign: list[FlightMode], ours: list[FlightMode]) -> None:
    for mode in foreign + ours:
        one = flight(phase, mode=mode, on_ground=False, position_ned_m=Ned(0.0, 0.0, -10.0))
        one.mode_before = STABLE if phase in (Phase.ARMED, Phase.LANDING) else None
        found = looks(LeftByPilot(), one, 0.0)
        assert found == (Finding(mode.name.upper()) if mode in foreign else None), mode
        assert looks(LeftByAutopilot(), one, 0.0) is None
        said(one).acts_by_itself = True
        assert looks(LeftByPilot(), one, 0.0) is None
        assert looks(LeftByAutopilot(), one, 0.0) == found


def test_a_landing_that_was_seen_may_fall_back_to_the_mode_before_and_to_any_on_the_ground() -> None:
    one = flight(Phase.LANDING, mode=HOLD, on_ground=False)
    one.land_seen, one.mode_before = True, STABLE
    assert looks(LeftByPilot(), one, 0.0) is not None
    for mode in (LAND, OFFBOARD, STABLE):
        said(one).mode = mode
        assert looks(LeftByPilot(), one, 0.0) is None
    said(one).mode, said(one).on_ground = HOLD, True
    assert looks(LeftByPilot(), one, 0.0) is None


def test_hold_mode_far_below_the_altitude_is_the_pilots_unless_positions_may_be_frozen() -> None:
    one = flight(Phase.CLIMBING, mode=HOLD, on_ground=False, position_ned_m=Ned(0.0, 0.0, -4.0))
    assert found_after(LeftByPilot(), one, STOPPED_LOW_S)
    one.positioned = False
    assert looks(LeftByPilot(), one, 9.0) is None
    one.positioned, one.engaging_since_ns = True, 1
    assert looks(LeftByPilot(), one, 9.0) is None


def test_an_arming_that_does_not_come_or_was_undone_ends_the_take_off() -> None:
    one = flight(Phase.PREFLIGHT)
    assert found_after(NotArmed(), one, TAKE_OFF_S)
    said(one).outcomes[Verb.ARM] = Outcome(0, accepted=True)
    assert looks(NotArmed(), one, 1.0) == Finding("disarmed again after it was armed; the take-off is given up")
    said(one).outcomes[Verb.ARM] = Outcome(0, accepted=False)
    assert looks(NotArmed(), one, 1.0) == Finding("the arming was not answered; the take-off is given up")
    said(one).mode = OFFBOARD
    assert looks(NotArmed(), one, 1.0) is None, "it cannot arm yet"


@pytest.mark.parametrize(("kind", "limit_s"), [(NoTakeOff, TAKE_OFF_S), (AltitudeNotReached, CLIMB_S)])
def test_a_phase_of_the_take_off_may_last_so_long(kind: type[Detector], limit_s: float) -> None:
    assert found_after(kind(), flight(min(kind.phases)), limit_s)


# -- the own position --------------------------------------------------------------------------------------------------


def test_positions_that_end_are_noted_once_and_lost_later() -> None:
    one = flight(Phase.HOLDING, on_ground=False)
    said(one).lives(at(0.0))
    notes, lost = [], []
    for k in range(1, 100):
        now = at(0.02 * k)
        one.observe(now, positioned=said(one).state(now) is not None)
        notes += [x for x in (PositionStale().look(one, now), PositionFrozen().look(one, now)) if x is not None]
        lost += [now.monotonic_ns * 1e-9] if PositionLost().look(one, now) else []
    assert notes == [Note("no setpoints")]
    assert lost[0] == pytest.approx(LOST_S, abs=0.04)


def test_positions_that_freeze_are_told_from_those_that_end() -> None:
    one = flight(Phase.MOVING, on_ground=False)
    for k in range(80):
        one.positions.see(at(0.02 * k).monotonic_ns, ZERO, Ned(1.0, 0.0, 0.0))
    now = at(1.6)
    one.observe(now, positioned=not one.positions.frozen)
    assert PositionFrozen().look(one, now) == Note("no setpoints")
    assert PositionStale().look(one, now) is None


@pytest.mark.parametrize("estimate", [Estimate(3, 7, 0.5), Estimate(7, 7, 3.01), Estimate(7, 7, float("nan"))])
def test_an_estimate_that_nobody_may_fly_by_is_found_after_two_of_them(estimate: Estimate) -> None:
    assert found_after(PositionUncertain(), flight(Phase.FORMED, sure=estimate), UNCERTAIN_S)


def test_an_origin_that_creeps_is_measured_since_the_vehicle_was_engaged() -> None:
    one = flight(Phase.FORMED, origin_crept_ned_m=Ned(5.0, 0.0, CREEP_LIMIT_M - JUST))
    one.engaged_origin_crept_ned_m = Ned(5.0, 0.0, 0.0)
    assert looks(PositionUncertain(), one, 0.0) is None
    said(one).origin_crept_ned_m = Ned(5.0, 0.0, CREEP_LIMIT_M + JUST)
    assert looks(PositionUncertain(), one, 0.0) == Finding("estimator's origin has crept 1.0 m")


def jump(one: Flight, seconds: float) -> tuple[Finding | Note | None, Finding | Note | None]:
    """What the two detectors of jumps find of a jump at a time: (goes on, jumped)."""
    north = 9.0 * (one.positions.jumps + 1)
    one.positions.see(at(seconds).monotonic_ns, ZERO, ZERO)
    one.positions.see(at(seconds).monotonic_ns, Ned(north, 0.0, 0.0), ZERO)
    one.positions.restart()
    one.observe(at(seconds), positioned=True)
    return looks(PositionJumpsOn(), one, seconds), looks(PositionJumped(), one, seconds)


def test_of_a_series_of_jumps_the_first_is_said_and_a_long_one_ends_the_flight() -> None:
    one = flight(Phase.HOLDING, on_ground=False)
    assert jump(one, 1.0) == (None, Finding(said=False))
    seconds = 1.0
    while seconds + 2.0 < 1.0 + JUMPS_S:
        seconds += 2.0
        assert jump(one, seconds) == (None, Finding(said=True))
    assert jump(one, 1.0 + JUMPS_S + JUST)[0] == Finding()
    assert jump(one, 30.0) == (None, Finding(said=False)), "another series"


def test_a_jump_on_the_ground_is_taken_without_a_word() -> None:
    one = flight(Phase.IDLE)
    assert jump(one, 1.0) == (None, None)
    one.phase, said(one).on_ground = Phase.WAITING, False
    one.observe(at(1.1), positioned=True)
    assert looks(PositionJumped(), one, 1.1) is None


# -- the battery -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("kind", "key"), [(BatteryCritical, "critical"), (BatteryLow, "low")])
def test_a_battery_is_found_below_its_percentage_and_not_at_it(kind: type[Detector], key: str) -> None:
    limit = getattr(CONFIG.failsafe, f"battery_{key}_percent")
    at_it, below = (flight(Phase.FORMED, battery_percent=round(limit) - d) for d in (0, 1))
    detector = kind()
    assert [looks(detector, at_it, s) for s in (0.0, 10.0)] == [None, None]
    assert found_after(kind(), below, BATTERY_S)
    unknown = kind()
    nothing = flight(Phase.FORMED, battery_percent=-1)
    assert [looks(unknown, nothing, s) for s in (0.0, 10.0)] == [None, None]


def test_a_low_battery_is_said_once_a_flight_and_sends_the_fleet_home_only_from_a_formation() -> None:
    config = fleet(failsafe={"battery_low": "return"})
    one, detector = flight(Phase.WAITING, config, battery_percent=1), BatteryLow()
    looks(detector, one, 0.0)
    assert looks(detector, one, 5.0) == Finding("1 %", Action.LAND)
    assert looks(detector, one, 5.1) is None
    one.begun += 1
    one.history.adopt(config.motion_into("line", one.history.newest, at(10.0).fleet_ns, 0))
    assert looks(detector, one, 9.0) == Finding("1 %", Action.RETURN)


def test_a_battery_that_is_told_no_more_is_noted_in_flight_only() -> None:
    for phase in Phase:
        one, detector = flight(phase), BatteryUnknown()
        assert looks(detector, one, 0.0) is None
        said(one).battery_told = False
        assert looks(detector, one, 1.0) == (Note("last told 80 %") if phase in FLYING_PHASES else None)
        assert looks(detector, one, 2.0) is None


# -- the others --------------------------------------------------------------------------------------------------------


def hears(one: Flight, vehicle_id: int, now: Instant, phase: Phase = Phase.WAITING) -> None:
    newest = one.history.newest
    reference = one.history.reference(vehicle_id, now.fleet_ns)
    sample = PeerSample(vehicle_id, now.fleet_ns, reference.position_ned_m, ZERO, newest.revision, phase)
    one.peers.presence(vehicle_id, True, now)
    assert one.peers.accept(PeerMessage(7, 1, newest.start_ns, newest.issuer, sample, ()), now) is None


@pytest.mark.parametrize("missing", ["land", "continue"])
def test_the_others_are_waited_for_as_long_as_the_file_says(missing: str) -> None:
    config = fleet(peers={"missing": missing, "wait_s": 6.0})
    one, detector = flight(Phase.WAITING, config), OthersMissing()
    hears(one, 2, at(5.0))
    assert found_after(detector, one, 6.0)
    assert looks(detector, one, 6.1) == Finding("waited for vehicle 3 in vain", Action(missing))
    one.forms_without = True
    assert looks(detector, one, 6.2) is None


def test_whoever_hears_nobody_any_more_is_alone_once_and_for_long_later() -> None:
    config = fleet(trigger={"t_max_s": 2.0}, peers={"isolated_flight_s": 3.0}, failsafe={"isolated_hold_s": 4.0})
    one = flight(Phase.HOLDING, config)
    hears(one, 2, at(0.0))
    for i in one.peers.ids:
        one.peers.presence(i, False, at(0.0))
    found: dict[type[Detector], list[float]] = {Deaf: [], Alone: [], AloneForLong: []}
    for k in range(600):
        now = at(0.02 * k)
        one.observe(now, positioned=True)
        for kind in found:
            found[kind] += [0.02 * k] if kind().look(one, now) else []
    assert found[Deaf] == []
    assert found[Alone] == [pytest.approx(3.0, abs=0.05)]
    assert found[AloneForLong][0] == pytest.approx(7.0, abs=0.05)


def test_a_vehicle_stands_detached_as_long_as_it_would_wait_for_the_others() -> None:
    one = flight(Phase.DETACHED)
    assert looks(DetachedForLong(), one, 1e6) is None, "it is on its way"
    one.stands_since_ns = 0
    assert found_after(DetachedForLong(), one, CONFIG.peers.wait_s)
    one.isolated_since_ns = 1
    assert looks(DetachedForLong(), one, 1e6) is None, "there is nobody to come back to"
