"""What a campaign's flights suffer: drawn by the seed, and which failsafes each fault explains."""

from collections.abc import Sequence
from dataclasses import dataclass
from random import Random

from companion.core.failsafe import Failsafe
from companion.errors import ConfigError
from companion.wire.px4 import Px4Mode
from sim.study.attacks import PLANS, STATES
from sim.study.common import Config, table_of

ESTIMATE_FAULTS = frozenset({"gps_lost", "gps_stuck", "gps_wrong", "position_frozen", "estimator_reset", "noise"})
"""after these a vehicle does not know where it is, and nobody can: distance and fence are not judged for it"""
HANDED_OVER = frozenset({Px4Mode.AUTO_LOITER, Px4Mode.POSCTL})
"""the autopilot's hold, and the pilot's: who flies in them without a companion is in somebody's hands"""
_F = Failsafe
OF_THE_FLEET = frozenset({_F.MISSING, _F.ALONE, _F.DEAF, _F.ALONE_FOR_LONG, _F.DETACHED_FOR_LONG})
"""failsafes that a fault of another, or of the network, explains"""
_NO_POSITION = {_F.POSITION_LOST, _F.POSITION_JUMPED, _F.AUTOPILOT, _F.NOT_ARMED, _F.NO_TAKE_OFF}
"""no position, then one elsewhere; without setpoints the autopilot acts too"""
EXPLAINED: dict[str, frozenset[Failsafe]] = {
    kind: OF_THE_FLEET | own
    for kind, own in {
        "gps_lost": _NO_POSITION | {_F.POSITION_JUMPS, _F.COVARIANCE, _F.NOT_FOLLOWED},
        "position_frozen": _NO_POSITION | {_F.PILOT},
        "estimator_reset": {_F.POSITION_JUMPED},
        "noise": {_F.POSITION_JUMPED, _F.POSITION_JUMPS},
        "low_battery": {_F.BATTERY_LOW, _F.BATTERY_CRITICAL, _F.NOT_ARMED},
        "reboot": _NO_POSITION | {_F.HEARTBEAT},
        "mute": _NO_POSITION | {_F.HEARTBEAT},
        "pilot_takeover": {_F.PILOT, _F.NOT_ARMED},
        "pilot_sticks": {_F.PILOT, _F.NOT_ARMED},
        "rc_kill": {_F.POSITION_JUMPED, _F.NOT_ARMED},
        "slow_link": _NO_POSITION | {_F.HEARTBEAT},
        "killed": set(),
        "restarted": set(),
        "stalled": {_F.AUTOPILOT},
        "partition": set(),
        "states_lost": set(),
        "restarted_without_line": set(),
        "second_companion": set(),
        "forged_plan": set(),
        "forged_digest": set(),
        "gps_stuck": _NO_POSITION | {_F.POSITION_JUMPS, _F.COVARIANCE, _F.NOT_FOLLOWED},
        "gps_wrong": _NO_POSITION | {_F.POSITION_JUMPS, _F.COVARIANCE, _F.NOT_FOLLOWED},
        "link_lost": _NO_POSITION | {_F.HEARTBEAT, _F.PILOT},
        "wind": set(),
        "battery_empty": {_F.BATTERY_LOW, _F.BATTERY_CRITICAL, _F.NOT_ARMED, _F.AUTOPILOT},
        "px4_restarted": _NO_POSITION | {_F.HEARTBEAT, _F.PILOT},
    }.items()
}
"""fault -> the failsafes of the same vehicle that it explains, from when it comes on. Who falls strikes the ground; who
hovers where its frozen position is not believes that a pilot ended its climb."""
ON_PX4_ALONE = frozenset({"gps_stuck", "gps_wrong", "link_lost", "wind", "px4_restarted", "battery_empty"})
"""not drawn in lockstep"""
NETWORK_KINDS = frozenset({"partition"})
"""of the network as a whole, and of no vehicle"""
FALLS = frozenset({"rc_kill", "reboot", "px4_restarted"})
"""the motors stop, or the vehicle is at its pad anew"""


@dataclass(frozen=True, slots=True)
class Flight:
    """What is the same in every flight."""

    vehicles: int
    altitude_m: float
    seconds: float
    faults_from_s: float
    faults_to_s: float
    most_faults: int
    kinds: tuple[str, ...]
    """that are drawn; none named: all"""
    operator_s: float
    """after the take-off command: an operator lands who flies still, in flights with a forged plan"""
    loss: float
    delay_s: float
    fence_radius_m: float
    fence_floor_m: float
    fence_ceiling_m: float


@dataclass(frozen=True, slots=True)
class Drawn:
    """One fault of one flight."""

    at_s: float
    """after the take-off command"""
    vehicle_id: int
    """0: the network"""
    kind: str
    duration_s: float
    magnitude: float | str | None = None
    """how much; or in which way, where a kind has several"""


def flight_of(config: Config) -> Flight:
    """The set-up's flight; a missing or unknown key is refused, and a kind that there is not."""
    flight = table_of(config, "flight", Flight)
    if unknown := sorted(set(flight.kinds) - set(EXPLAINED)):
        raise ConfigError(
            f"{config.where}: $.flight.kinds: there is no {', '.join(unknown)}; known are {', '.join(EXPLAINED)}"
        )
    return flight


def drawn_faults(flight: Flight, seed: int) -> list[Drawn]:
    """The faults of a seed, in the order of their times.

    Every fault draws from a stream of its own, and its kind is the one whose own number is largest: another kind
    changes those faults alone that become of it, and in which order the kinds are written changes nothing.
    """
    faults = []
    for k in range(Random(f"campaign/{seed}").randint(1, flight.most_faults)):
        kind = max(
            sorted(flight.kinds or EXPLAINED.keys() - ON_PX4_ALONE),
            key=lambda kind: Random(f"campaign/{seed}/{k}/{kind}").random(),
        )
        random = Random(f"campaign/{seed}/{k}")
        at_s = random.uniform(flight.faults_from_s, flight.faults_to_s)
        i = random.randint(1, flight.vehicles)
        duration_s = random.choice((0.7, 3.0, 10.0, 1000.0))
        faults.append(Drawn(at_s, 0 if kind in NETWORK_KINDS else i, kind, duration_s, magnitude_of(kind, random)))
    return sorted(faults, key=lambda f: f.at_s)


def magnitude_of(kind: str, random: Random) -> float | str | None:
    match kind:
        case "noise":
            return random.uniform(0.2, 1.0)
        case "low_battery":
            return random.choice((0.05, 0.15))
        case "states_lost":
            return random.choice(("by one: states", "by one: states and plans", "by all: states"))
        case "second_companion":
            return random.choice(("on its line", "on another's line"))
        case "forged_plan":
            return random.choice(tuple(PLANS))
        case "forged_digest":
            return random.choice(tuple(STATES))
    return None


def explained(told: tuple[float, int, Failsafe], faults: Sequence[Drawn]) -> bool:
    """Whether a fault that came before it explains a failsafe."""
    at_s, i, failsafe = told
    before = [f for f in faults if f.at_s <= at_s]
    return any(failsafe in (EXPLAINED[f.kind] if f.vehicle_id == i else OF_THE_FLEET) for f in before)
