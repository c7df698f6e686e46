"""The failsafes: one table of what may fail, when it is noticed, what a vehicle does, and how that is left again.

The flight acts by this table, `docs/failsafes.md` shows it, and the tests inject each row's fault.
"""

from enum import Enum, unique
from typing import NamedTuple


@unique
class Action(Enum):
    """What a vehicle does when something fails."""

    CONTINUE = "continue"
    LEAVE_FORMATION = "leave formation"
    """stand by itself, apart from the formation"""
    LAND = "land"
    """the autopilot's AUTO.LAND, where the vehicle is"""
    RETURN = "return"
    """the whole fleet flies back over its pads and lands there"""
    HAND_OVER = "hand over"
    """no setpoint any more: pilot or autopilot have the vehicle"""


@unique
class Failsafe(Enum):
    """What may fail."""

    POSITION_STALE = "own position stale"
    POSITION_FROZEN = "own position frozen"
    POSITION_LOST = "own position lost"
    POSITION_JUMPED = "own position jumped"
    POSITION_JUMPS = "own position goes on jumping"
    COVARIANCE = "own position uncertain"
    NOT_FOLLOWED = "setpoints not followed"
    HEARTBEAT = "autopilot's heartbeat lost"
    PILOT = "OFFBOARD left by the pilot"
    AUTOPILOT = "OFFBOARD left by the autopilot's failsafe"
    NOT_ARMED = "autopilot does not arm"
    NO_TAKE_OFF = "autopilot does not take off"
    ALTITUDE = "altitude not reached"
    MISSING = "the others never come"
    ALONE = "all peers lost"
    ALONE_FOR_LONG = "all peers lost for long"
    DETACHED_FOR_LONG = "no way back to the formation"
    PEER_GONE = "a peer's companion ends"
    PEER_SILENT = "a peer falls silent"
    PEER_FROZEN = "a peer's position frozen"
    PEER_LIES = "a peer's state jumps"
    PEER_CLOCK = "a peer's clock off"
    TWO_SOURCES = "two sources under one id"
    OWN_ID = "own id heard from another"
    DEAF = "nobody's states heard"
    BATTERY_LOW = "battery low"
    BATTERY_CRITICAL = "battery critical"
    BATTERY_UNKNOWN = "battery unknown"
    LOOP_LATE = "control loop late"
    DISK_FULL = "disk full"
    CONFIGURATION = "configuration changed on disk"
    KILLED = "own companion killed"
    STOPPED = "own companion asked to end"
    OPERATOR = "operator lost"
    NOT_FINITE = "a number not finite, a message malformed"


@unique
class NoticedBy(Enum):
    """Who notices a failsafe."""

    DETECTOR = "a detector of the supervisor's (`vehicle.detectors`)"
    PEER_TABLE = "the table of peers (`core.neighbours`)"
    AGENT = "the agent, at its inputs and ticks"
    PROCESS = "the process around the agent (`io`)"
    AUTOPILOT = "the autopilot alone: its own failsafe acts"
    NOBODY = "nobody"


class Row(NamedTuple):
    """One failsafe."""

    noticed: str
    """after how long; `keys` are those of fleet.toml"""
    limit_s: float | None
    """the same as a number where it is a constant (s); detection may take a control period and a message more"""
    action: Action
    more: str
    """what else is done, or why so"""
    left: str
    by: NoticedBy = NoticedBy.DETECTOR


STALE_S = 0.5
FROZEN_S = 0.5
LOST_S = 1.5
"""the autopilot acts COM_OF_LOSS_T (1 s) after the last setpoint, which was made from a position STALE_S old"""
HEARTBEAT_S = 3.0
UNCERTAIN_S = 2.0
"""ESTIMATOR_STATUS comes once a second: two in a row"""
ACCURACY_LIMIT_M = 3.0
"""PX4's own limit for arming (EKF2_REQ_EPH); flags alone stay up for seconds after the position sensor's end"""
NOT_FOLLOWED_S = 2.0
NOT_FOLLOWED_M_S, NOT_FOLLOWED_SHARE = 2.0, 0.5
"""level difference of the own velocity from the one asked for, and its share of `limits.speed_max_m_s`: the larger
counts. In flights on PX4 the difference is below 1.3 m/s, steps of wind included"""
STATUS_S = 5.0
"""ESTIMATOR_STATUS or SYS_STATUS, which come once a second, older than this: what it said is unknown"""
BATTERY_S = 3.0
JUMPS_S = 10.0
LATE_S = 0.2
CLIMB_S = 60.0
TAKE_OFF_S = 10.0
MODE_S = 0.1
DAMAGE_M = 0.5
DAMAGE_M_S = 0.5
CREEP_LIMIT_M = 1.0
"""an estimator's origin that has moved so far, each time by less than DAMAGE_M, belongs to an estimate nobody knows"""
LISTEN_S = 3.0
"""a vehicle that is apart listens this long before it comes back"""
SUSPECT_S = 5.0
"""a peer that lied is trusted again after so long without another lie"""
CONFIGURATION_S = 5.0

_BY_COMMAND = "`fleet resume`; or after landing and disarming, by a new take-off command"
_NOT = "-"

FAILSAFES: dict[Failsafe, Row] = {
    Failsafe.POSITION_STALE: Row(
        "0.5 s", STALE_S, Action.HAND_OVER, "no setpoint; the autopilot's failsafe acts COM_OF_LOSS_T later",
        "a position comes before that",
    ),
    Failsafe.POSITION_FROZEN: Row(
        "0.5 s without a change at more than 0.1 m/s", FROZEN_S, Action.HAND_OVER, "as stale", "it changes before that",
    ),
    Failsafe.POSITION_LOST: Row(
        "1.5 s stale or frozen", LOST_S, Action.HAND_OVER,
        "released, and the peers are told: they keep all the distance",
        _BY_COMMAND,
    ),
    Failsafe.POSITION_JUMPED: Row(
        "in the air, the first position 0.5 m or 0.5 m/s beyond what the motion explains (10 sigma of "
        "`limits.*_noise_*` if more)",
        0.0, Action.LEAVE_FORMATION,
        "where it now believes to be; the estimator's origin is asked for again, as it is after a jump on the ground",
        "3 s after the last jump it comes back to its slot",
    ),
    Failsafe.POSITION_JUMPS: Row("10 s of jumps", JUMPS_S, Action.LAND, "", _NOT),
    Failsafe.COVARIANCE: Row(
        "2 s of ESTIMATOR_STATUS with flags missing, an accuracy worse than 3 m or not above 0, or none for 5 s; "
        "at once when the origin has crept 1 m, by less than 0.5 m each time", UNCERTAIN_S,
        Action.LAND, "the estimate may drift towards the others", _NOT,
    ),
    Failsafe.NOT_FOLLOWED: Row(
        "2 s at more than 2 m/s (half of `limits.speed_max_m_s` if more) from the level velocity asked for",
        NOT_FOLLOWED_S, Action.LAND,
        "the estimate runs away (a GPS that is stuck), an actuator has failed, or a wind is stronger than the vehicle",
        _NOT,
    ),
    Failsafe.HEARTBEAT: Row("3 s", HEARTBEAT_S, Action.HAND_OVER, "released", _BY_COMMAND),
    Failsafe.PILOT: Row(
        "the next CURRENT_MODE (20 Hz) or HEARTBEAT", MODE_S, Action.HAND_OVER,
        "released: the stream stops for good, since PX4 returns to OFFBOARD by itself when it resumes", _BY_COMMAND,
    ),
    Failsafe.AUTOPILOT: Row(
        "the next CURRENT_MODE (20 Hz) or HEARTBEAT", MODE_S, Action.HAND_OVER, "the same", _BY_COMMAND,
    ),
    Failsafe.NOT_ARMED: Row(
        "10 s; at once where a heartbeat after the arming says disarmed: the pilot's word", TAKE_OFF_S, Action.CONTINUE,
        "the take-off is given up, on the ground", "take-off",
    ),
    Failsafe.NO_TAKE_OFF: Row("10 s armed", TAKE_OFF_S, Action.LAND, "", _NOT),
    Failsafe.ALTITUDE: Row("60 s of climb", CLIMB_S, Action.LAND, "", _NOT),
    Failsafe.MISSING: Row(
        "`peers.wait_s` after reaching altitude", None, Action.LAND,
        '`peers.missing = "continue"`: those that are up form without them', _NOT,
    ),
    Failsafe.ALONE: Row(
        "`peers.isolated_flight_s` after the last one ended or was silent for 2.1 `trigger.t_max_s`", None,
        Action.LEAVE_FORMATION, "", "a peer is heard: it comes back to its slot",
    ),
    Failsafe.DEAF: Row(
        "12 heartbeats due from two or more peers that are said to be there, none heard: 1.4 `trigger.t_max_s` with "
        "ten vehicles; with few, `peers.isolated_flight_s` after 2.1", None, Action.LEAVE_FORMATION,
        "the link is gone, not the peers: each is taken to fly on until it must have noticed too, then to stand",
        "a peer is heard: it comes back to its slot",
    ),
    Failsafe.ALONE_FOR_LONG: Row("`failsafe.isolated_hold_s` of that hold", None, Action.LAND, "", _NOT),
    Failsafe.DETACHED_FOR_LONG: Row("`peers.wait_s` apart", None, Action.LAND, "no plan was told, say", _NOT),
    Failsafe.PEER_GONE: Row(
        "milliseconds when the process ends, `peers.notice_lost_s` when its computer or radio does", None,
        Action.CONTINUE,
        "all the distance is kept to everywhere it may be: flown on with the plan, or stopped", "it is heard again",
        by=NoticedBy.PEER_TABLE,
    ),
    Failsafe.PEER_SILENT: Row(
        "2.1 `trigger.t_max_s`", None, Action.CONTINUE, "the same", "it is heard again", by=NoticedBy.PEER_TABLE,
    ),
    Failsafe.PEER_FROZEN: Row(
        "its samples repeat a position for 0.5 s at more than 0.1 m/s", FROZEN_S, Action.CONTINUE,
        "not used in the formation, all the distance is kept to it, counted", "5 s without another",
        by=NoticedBy.PEER_TABLE,
    ),
    Failsafe.PEER_LIES: Row(
        "the first sample further than 1 m (1 m/s) from what was foreseen, beyond what a second of 8 m/s2 explains, or "
        "on the ground without a landing", 0.0, Action.CONTINUE,
        "not used in the formation; all the distance is kept to both places, counted",
        "one of them is not told of for 2.1 `trigger.t_max_s`; of a vehicle lost in the air while elsewhere one says "
        "that it stands, for 120 s",
        by=NoticedBy.PEER_TABLE,
    ),
    Failsafe.PEER_CLOCK: Row(
        "a sample from more than 1 s ahead, or older on arrival than 2.1 `trigger.t_max_s`", 0.0, Action.CONTINUE,
        "refused and counted; then it is silent", "its clock is right",
        by=NoticedBy.PEER_TABLE,
    ),
    Failsafe.TWO_SOURCES: Row(
        "a boot id that speaks again after another has begun", 0.0, Action.CONTINUE,
        "not used in the formation; all the distance is kept to every place that is told, counted, noted",
        "2.1 `trigger.t_max_s` without the other",
        by=NoticedBy.PEER_TABLE,
    ),
    Failsafe.OWN_ID: Row(
        "the first put under the own id", 0.0, Action.CONTINUE,
        "not taken; it says at once where it is itself (twice a second at most), counted, noted, no take-off by "
        "`fleet preflight`; to land for it would let one put end a flight",
        "2.1 `trigger.t_max_s` without another",
        by=NoticedBy.AGENT,
    ),
    Failsafe.BATTERY_LOW: Row(
        "3 s below `failsafe.battery_low_percent`", BATTERY_S, Action.RETURN,
        "with `failsafe.battery_low`: return, land or continue; land where there is no formation yet and where the way "
        "back would leave the fence", _NOT,
    ),
    Failsafe.BATTERY_CRITICAL: Row("3 s below `failsafe.battery_critical_percent`", BATTERY_S, Action.LAND, "", _NOT),
    Failsafe.BATTERY_UNKNOWN: Row(
        "5 s without SYS_STATUS, or one that no longer tells it", STATUS_S, Action.CONTINUE,
        "noted and counted; the autopilot's COM_LOW_BAT_ACT acts", "it is told again",
    ),
    Failsafe.LOOP_LATE: Row(
        "0.2 s between two control ticks", LATE_S, Action.CONTINUE,
        "counted; from COM_OF_LOSS_T on the autopilot's failsafe acts", "the next tick",
        by=NoticedBy.AGENT,
    ),
    Failsafe.DISK_FULL: Row(
        "the first write that fails", None, Action.CONTINUE, "losses are counted", "there is room",
        by=NoticedBy.PROCESS,
    ),
    Failsafe.CONFIGURATION: Row(
        "5 s", None, Action.CONTINUE, "noted; the vehicle flies on what it was started with", "a new start",
        by=NoticedBy.PROCESS,
    ),
    Failsafe.KILLED: Row(
        "the autopilot's COM_OF_LOSS_T (1.0 s)", 1.0, Action.HAND_OVER,
        "the autopilot's COM_OBL_RC_ACT; launchers set 4, land; in the climb it climbs on and holds; "
        "one that starts in flight steers only on command",
        "`fleet resume`",
        by=NoticedBy.AUTOPILOT,
    ),
    Failsafe.STOPPED: Row(
        "SIGTERM, SIGINT, the launcher's end: at once", 0.0, Action.LAND,
        "it ends once the autopilot confirms (3 s, or 1.2 s without a launcher)", _NOT,
        by=NoticedBy.PROCESS,
    ),
    Failsafe.OPERATOR: Row(
        "not at all", None, Action.CONTINUE, "nothing in flight needs the operator", _NOT, by=NoticedBy.NOBODY,
    ),
    Failsafe.NOT_FINITE: Row(
        "at once", 0.0, Action.CONTINUE, "refused and counted; never in a setpoint", _NOT, by=NoticedBy.AGENT,
    ),
}  # fmt: skip


def table() -> str:
    """The rows as the table of the docs, in Markdown."""
    lines = ["| what fails | noticed after | action | how it is left |", "|---|---|---|---|"]
    for failsafe, row in FAILSAFES.items():
        action = f"{row.action.value}: {row.more}" if row.more else row.action.value
        lines.append(f"| {failsafe.value} | {row.noticed} | {action} | {row.left} |")
    return "\n".join(lines) + "\n"
