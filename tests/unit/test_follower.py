"""Where a vehicle is to be: in its slot, on a way of its own, and whether it has arrived."""

from itertools import pairwise
from math import dist

import pytest
from test_detectors import hears
from toy_autopilot import CONFIG, at, flight, said

from companion.core.failsafe import LISTEN_S
from companion.core.frames import Ned
from companion.core.phase import PhaseEvent, next_phase
from companion.core.values import ZERO, Instant, Phase, VehicleState
from companion.vehicle.flight import Flight
from companion.vehicle.follower import (
    ENGAGED_AWAY_M,
    RETURNED_LIMIT_NS,
    SETTLED_FOR_NS,
    SETTLED_TOLERANCE_M,
    Follower,
)

PERIOD_S = 0.02


class Followed:
    """A follower on a flight whose phases go as the table says."""

    def __init__(self, phase: Phase) -> None:
        self.flight: Flight = flight(phase, on_ground=False)
        self.follower = Follower(self.flight, self.happened)
        self.told: list[PhaseEvent] = []
        self.slot = self.flight.history.reference(1, at(0.0).fleet_ns)
        self.seconds = 0.0

    def happened(self, event: PhaseEvent, now: Instant) -> None:
        self.told.append(event)
        after = next_phase(self.flight.phase, event)
        if after is not self.flight.phase:
            self.flight.phase, self.flight.phase_since_ns = after, now.monotonic_ns
            self.follower.phase_changed(event)

    def stands_at(self, north_m: float, east_m: float = 0.0, down_m: float = 0.0) -> VehicleState:
        """The vehicle stands so far from its slot."""
        s = self.slot.position_ned_m
        place = Ned(s.north + north_m, s.east + east_m, s.down + down_m)
        said(self.flight).position_ned_m = place
        return VehicleState(at(self.seconds).fleet_ns, place, ZERO)

    def follow(self, ego: VehicleState, seconds: float, resuming: bool = False) -> list[Ned]:
        """The own references of so many seconds."""
        places = []
        for _ in range(round(seconds / PERIOD_S)):
            self.seconds += PERIOD_S
            places.append(self.follower.follow(self.slot, ego, at(self.seconds), resuming).position_ned_m)
        return places

    def moves_slot(self, north_m: float) -> None:
        p = self.slot.position_ned_m
        self.slot = self.slot._replace(position_ned_m=Ned(p.north + north_m, p.east, p.down))


def test_in_formation_the_reference_is_the_slots() -> None:
    one = Followed(Phase.FORMED)
    assert set(one.follow(one.stands_at(0.0), 1.0)) == {one.slot.position_ned_m}
    assert one.told == []


@pytest.mark.parametrize(("away_m", "strays"), [(ENGAGED_AWAY_M - 0.01, False), (ENGAGED_AWAY_M + 0.01, True)])
def test_whoever_engages_far_from_its_slot_stands_first(away_m: float, strays: bool) -> None:
    one = Followed(Phase.WAITING)
    one.follower.phase_changed(PhaseEvent.ENGAGED)
    ego = one.stands_at(away_m)
    first = one.follow(ego, PERIOD_S)[0]
    assert (one.told == [PhaseEvent.STRAYED]) is strays
    assert first == (ego.position_ned_m if strays else one.slot.position_ned_m)


def test_a_slot_that_jumps_is_come_to_smoothly_and_the_formation_joined_again() -> None:
    one = Followed(Phase.FORMED)
    ego = one.stands_at(0.0)
    before = one.follow(ego, 1.0)
    one.moves_slot(12.0)
    way = one.follow(ego, 30.0)
    steps_m = [dist(a, b) for a, b in pairwise(before + way)]
    assert max(steps_m) <= CONFIG.limits.speed_max_m_s * PERIOD_S
    assert way[-1] == one.slot.position_ned_m
    assert one.told == [PhaseEvent.STRAYED, PhaseEvent.REJOINED]
    assert one.flight.stands_since_ns is None


def test_who_stands_detached_waits_until_it_hears_somebody_and_has_the_newest_plan() -> None:
    one = Followed(Phase.FORMED)
    ego = one.stands_at(5.0)
    one.follower.stand(at(0.0))
    assert one.flight.stands_since_ns == 0
    assert set(one.follow(ego, LISTEN_S + 1.0)) == {ego.position_ned_m}, "nobody is heard"
    one.flight.outdated = True
    hears(one.flight, 2, at(one.seconds))
    assert set(one.follow(ego, 1.0)) == {ego.position_ned_m}, "a peer holds a newer plan"
    one.flight.outdated = False
    hears_on = one.follow(ego, 5.0)
    assert dist(hears_on[-1], ego.position_ned_m) > 1.0
    assert one.flight.stands_since_ns is None


def test_who_is_heard_at_once_is_listened_to_for_a_while_first() -> None:
    one = Followed(Phase.FORMED)
    ego = one.stands_at(5.0)
    one.follower.stand(at(0.0))
    hears(one.flight, 2, at(0.0))
    places = one.follow(ego, LISTEN_S + 2.0)
    left_s = PERIOD_S * next(k for k, p in enumerate(places) if p != ego.position_ned_m)
    assert left_s == pytest.approx(LISTEN_S, abs=0.2)


def test_while_setpoints_stream_for_nobody_the_reference_is_where_the_vehicle_is() -> None:
    one = Followed(Phase.RELEASED)
    ego = one.stands_at(7.0)
    assert set(one.follow(ego, 1.0, resuming=True)) == {ego.position_ned_m}
    assert one.told == []


def forming() -> tuple[Followed, float]:
    """A vehicle that forms by a change of formation, and when (s) that is over."""
    one = Followed(Phase.FORMING)
    history = one.flight.history
    assert history.adopt(CONFIG.motion_into("line", history.newest, at(1.0).fleet_ns, 0))
    over_s = (history.newest.blend_end_ns - at(0.0).fleet_ns) * 1e-9
    one.slot = history.reference(1, history.newest.blend_end_ns)
    return one, over_s


@pytest.mark.parametrize(
    ("north_m", "down_m", "near"),
    [(SETTLED_TOLERANCE_M - 0.01, 0.0, True), (SETTLED_TOLERANCE_M + 0.01, 0.0, False), (0.0, 0.99, True),
     (0.0, 1.01, False), (float("nan"), 0.0, False)],
)  # fmt: skip
def test_who_is_near_its_slot_for_a_second_after_the_change_has_settled(
    north_m: float, down_m: float, near: bool
) -> None:
    one, over_s = forming()
    ego = one.stands_at(north_m, down_m=down_m)
    arrived = {}
    for k in range(200):
        seconds = over_s - 1.0 + PERIOD_S * k
        event = one.follower.arrived(ego, one.slot, at(seconds))
        if event is not None:
            arrived[event] = min(seconds, arrived.get(event, seconds))
    if near:
        assert arrived == {PhaseEvent.SETTLED: pytest.approx(over_s + SETTLED_FOR_NS * 1e-9, abs=0.05)}
        assert one.follower.settled_blend_ns == one.flight.history.newest.blend_start_ns
    else:
        assert arrived == {}


def test_who_leaves_the_slot_meanwhile_begins_anew() -> None:
    one, over_s = forming()
    near, far = one.stands_at(0.0), one.stands_at(2.0)
    assert one.follower.arrived(near, one.slot, at(over_s + 0.1)) is None
    assert one.follower.arrived(far, one.slot, at(over_s + 0.8)) is None
    assert one.follower.arrived(near, one.slot, at(over_s + 0.9)) is None
    assert one.follower.arrived(near, one.slot, at(over_s + 1.8)) is None
    assert one.follower.arrived(near, one.slot, at(over_s + 1.9)) is PhaseEvent.SETTLED


def test_who_does_not_get_over_its_pad_lands_where_it_is() -> None:
    one = Followed(Phase.RETURNING)
    history = one.flight.history
    assert history.adopt(CONFIG.motion_into("line", history.newest, at(1.0).fleet_ns, 0))
    home = CONFIG.motion_home(history.newest, history.newest.blend_end_ns + 1, 0)
    assert history.adopt(home)
    assert home.end_ns is not None
    far, limit_ns = one.stands_at(5.0), home.end_ns + RETURNED_LIMIT_NS - at(0.0).fleet_ns
    assert one.follower.arrived(far, one.slot, at(limit_ns * 1e-9 - 0.01)) is None
    assert one.follower.arrived(far, one.slot, at(limit_ns * 1e-9 + 0.01)) is PhaseEvent.LAND
