"""Commands that are obeyed and not done yet: asked for until they are done, and given up after their limit."""

from toy_autopilot import STABLE, ToyAutopilot, at

from companion.core.events import Event, KillGivenUp, ResumeGivenUp
from companion.vehicle.autopilot.port import HOLD, LAND, OFFBOARD, TAKE_OFF, Verb
from companion.vehicle.pending import (
    KILL_LIMIT_NS,
    LATE_MODE_NS,
    RELEASE_LIMIT_NS,
    RESUME_LIMIT_NS,
    STREAM_BEFORE_NS,
    Done,
    PendingCommands,
)

NOTHING = Done(killed=False, resumed=False)
PERIOD_S = 0.02


def pending(**said: object) -> tuple[PendingCommands, ToyAutopilot, list[Event]]:
    autopilot, events = ToyAutopilot(obedient=False, **said), []  # type: ignore[arg-type]
    return PendingCommands(autopilot, events), autopilot, events


def asked_until(commands: PendingCommands, autopilot: ToyAutopilot, verb: Verb, end_s: float) -> float:
    """When a verb was last asked for in ticks from 0 s on."""
    last_s = -1.0
    for k in range(round(end_s / PERIOD_S)):
        before = autopilot.asked.count(verb)
        assert commands.advance(at(k * PERIOD_S)) == NOTHING
        last_s = k * PERIOD_S if autopilot.asked.count(verb) > before else last_s
    return last_s


def test_a_kill_is_done_by_a_heartbeat_that_came_after_it() -> None:
    commands, autopilot, events = pending(armed=True)
    autopilot.lives(at(1.0))
    commands.kill(at(1.0))
    assert commands.killing
    autopilot.armed = False
    assert commands.advance(at(1.5)) == NOTHING, "an old heartbeat says nothing of it"
    autopilot.lives(at(1.6))
    assert commands.advance(at(1.6)) == Done(killed=True)
    assert autopilot.withdrawn == [Verb.KILL]
    assert commands.none
    assert events == []


def test_a_kill_of_what_did_not_run_has_killed_nothing() -> None:
    commands, autopilot, _ = pending(armed=False)
    commands.kill(at(1.0))
    autopilot.lives(at(1.1))
    assert commands.advance(at(1.1)) == NOTHING
    assert commands.none


def test_a_kill_that_does_not_work_is_given_up_and_cannot_stop_a_later_flight() -> None:
    commands, autopilot, events = pending(armed=True)
    commands.kill(at(0.0))
    limit_s = KILL_LIMIT_NS * 1e-9
    assert limit_s - 2 * PERIOD_S < asked_until(commands, autopilot, Verb.KILL, limit_s + 2.0) <= limit_s
    assert events == [KillGivenUp()]
    assert autopilot.withdrawn == [Verb.KILL]


def test_a_kill_leaves_nothing_else_wanted() -> None:
    commands, autopilot, _ = pending(armed=True)
    commands.resume(at(0.0))
    commands.hold_after({OFFBOARD}, at(0.0))
    commands.kill(at(0.0))
    assert not commands.resuming
    autopilot.mode = OFFBOARD
    commands.advance(at(0.5))
    assert set(autopilot.asked) == {Verb.KILL}


def test_hold_mode_is_asked_for_until_it_is_there_or_too_long() -> None:
    commands, autopilot, _ = pending(mode=OFFBOARD)
    commands.hold_after({OFFBOARD}, at(0.0))
    limit_s = RELEASE_LIMIT_NS * 1e-9
    assert limit_s - 2 * PERIOD_S < asked_until(commands, autopilot, Verb.HOLD, limit_s + 2.0) <= limit_s
    assert commands.none


def test_whoever_chooses_another_mode_has_the_vehicle() -> None:
    for chosen in (STABLE, HOLD, LAND):
        commands, autopilot, _ = pending(mode=OFFBOARD)
        commands.hold_after({OFFBOARD, LAND} - {chosen}, at(0.0))
        autopilot.mode = chosen
        assert asked_until(commands, autopilot, Verb.HOLD, LATE_MODE_NS * 1e-9 + 1.0) < 0
        assert commands.none


def test_a_mode_that_comes_late_is_left_and_one_that_was_chosen_since_is_not() -> None:
    commands, autopilot, _ = pending(mode=STABLE)
    commands.hold_after({STABLE, OFFBOARD, TAKE_OFF}, at(0.0))
    commands.advance(at(0.1))
    assert autopilot.asked == [Verb.HOLD]
    autopilot.mode = LAND
    commands.advance(at(0.2))
    autopilot.mode = OFFBOARD
    commands.advance(at(0.3))
    assert autopilot.asked == [Verb.HOLD] * 2
    autopilot.mode = STABLE
    commands.advance(at(0.4))
    assert autopilot.asked == [Verb.HOLD] * 2


def test_setpoints_stream_before_the_autopilot_is_asked_to_follow_them_again() -> None:
    commands, autopilot, events = pending(armed=True, mode=HOLD)
    commands.resume(at(0.0))
    assert commands.resuming
    assert commands.advance(at(STREAM_BEFORE_NS * 1e-9)) == NOTHING
    assert autopilot.asked == []
    assert commands.advance(at(STREAM_BEFORE_NS * 1e-9 + 0.001)) == NOTHING
    assert autopilot.asked == [Verb.ENGAGE]
    autopilot.mode = OFFBOARD
    assert commands.advance(at(0.5)) == Done(resumed=True)
    assert commands.none
    assert events == []


def test_a_resume_is_given_up_after_its_limit_and_offboard_that_comes_late_is_left() -> None:
    commands, autopilot, events = pending(armed=True, mode=HOLD)
    commands.resume(at(0.0))
    end_s = RESUME_LIMIT_NS * 1e-9
    assert asked_until(commands, autopilot, Verb.ENGAGE, end_s + 0.5) <= end_s
    assert events == [ResumeGivenUp("HOLD")]
    assert Verb.ENGAGE in autopilot.withdrawn
    autopilot.mode = OFFBOARD
    commands.advance(at(end_s + 0.6))
    assert autopilot.asked[-1] is Verb.HOLD


def test_a_resume_of_what_is_disarmed_is_given_up_at_once() -> None:
    commands, autopilot, events = pending(armed=True, mode=HOLD)
    commands.resume(at(0.0))
    autopilot.armed = False
    commands.advance(at(0.1))
    assert not commands.resuming
    assert events == [ResumeGivenUp("HOLD")]
