"""The way back to a slot: it begins where the vehicle is, at rest or in motion, and ends in the slot; nothing jumps."""

import pytest

from companion.core.frames import Ned
from companion.core.rejoin import RejoinTrajectory
from companion.core.trajectory.fleet import Reference

ZERO = Ned(0.0, 0.0, 0.0)
SECOND = 1_000_000_000


def slot(fleet_ns: int) -> Reference:
    """A slot that flies north at 1 m/s."""
    return Reference(Ned(fleet_ns / SECOND, 0.0, -10.0), Ned(1.0, 0.0, 0.0), ZERO, 0.0)


def test_it_stands_until_it_sets_out() -> None:
    way = RejoinTrajectory(Ned(3.0, 4.0, -8.0))
    assert way.reference(slot(9 * SECOND), 9 * SECOND) == Reference(Ned(3.0, 4.0, -8.0), ZERO, ZERO, 0.0)
    assert not way.over(10**18)


def test_position_velocity_and_acceleration_go_on_smoothly_from_standing_to_the_moving_slot() -> None:
    way = RejoinTrajectory(Ned(3.0, 4.0, -8.0))
    way.come_back(slot(0), way.reference(slot(0), 0), 0, 2.0)
    begin = way.reference(slot(0), 0)
    assert begin.position_ned_m == pytest.approx((3.0, 4.0, -8.0))
    assert begin.velocity_ned_m_s == pytest.approx(ZERO, abs=1e-12)
    step_ns, t = 10_000_000, 0
    before = begin
    while not way.over(t):
        t += step_ns
        now = way.reference(slot(t), t)
        for p, q, v in zip(before.position_ned_m, now.position_ned_m, before.velocity_ned_m_s, strict=True):
            assert q - p == pytest.approx(v * 0.01, abs=1e-4)
        for v, w, a in zip(before.velocity_ned_m_s, now.velocity_ned_m_s, before.acceleration_ned_m_s2, strict=True):
            assert w - v == pytest.approx(a * 0.01, abs=1e-3)
        before = now
    assert before.position_ned_m == pytest.approx(slot(t).position_ned_m)
    assert before.velocity_ned_m_s == pytest.approx(slot(t).velocity_ned_m_s)
