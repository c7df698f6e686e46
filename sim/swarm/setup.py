"""What a run of the swarm is: its set-up, as a study's TOML file says it. Nothing here needs numba."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any, Literal, get_args, get_origin

import numpy as np
from pydantic import ValidationError

from companion.config.law_tables import LAWS, LawTable
from companion.config.messages import sentence
from companion.core.formation import SHAPES
from companion.core.monitor import PeerMotion
from companion.core.safety.filter import COLLISION_DISTANCE_M, LAG_ALLOWANCE_M
from companion.core.trigger import base as rule
from companion.core.trigger.error import ErrorTrigger
from companion.core.trigger.periodic import PeriodicTrigger
from companion.core.trigger.switching import SwitchingTrigger
from companion.errors import ConfigError
from sim.swarm.state import DIGEST_MAX, Floats

DENSE_MAX = 300
"""up to here every ordered pair may have its own row"""


@dataclass(frozen=True, slots=True)
class Formation:
    """Where the slots are."""

    shape: str = "v"
    """v (steps along and across), helix, cloud (a sheared grid), or a shape of `companion.core.formation`"""
    count: int = 10
    along_m: float = 1.5
    """v: step along the heading from one vehicle of an arm to the next"""
    across_m: float = 1.5
    """v: step across the heading"""
    up_m: float = 0.0
    """v: step upward"""
    open_m: float = 0.0
    """v: distance between the two foremost vehicles of two equal arms; 0: one vehicle leads"""
    spacing_m: float = 1.5
    """named shapes and cloud: spacing; helix: arc between neighbours, seen from above"""
    radius_m: float = 3.0
    """helix: radius"""
    rise_m: float = 0.5
    """helix: rise from one vehicle to the next"""
    first_at_tips: bool = False
    """v: agents 1 and 6 stand at the wing tips (agents run along each arm from tip to apex)"""

    def slots(self) -> Floats:
        """Offsets (forward, right, down) from the formation's centre, shape (count, 3), m."""
        n = self.count
        if self.shape == "v":
            k = np.arange(n)
            arm = k // 2 if self.open_m > 0 else (k + 1) // 2
            side = np.where(k % 2 == 1, 1.0, -1.0)
            y = (self.across_m * arm + self.open_m / 2) * side
            d = np.stack([-self.along_m * arm, y, -self.up_m * arm], axis=1)
            if self.first_at_tips:
                # arms listed one after the other, each from its tip inward
                right = [i for i in reversed(range(n)) if i % 2 == 1]
                left = [i for i in reversed(range(n)) if i % 2 == 0]
                first, second = (right, left) if len(right) >= len(left) else (left, right)
                d = d[np.array([*first, *second])]
        elif self.shape == "helix":
            angle = np.arange(n) * self.spacing_m / self.radius_m
            d = np.stack([self.radius_m * np.cos(angle), self.radius_m * np.sin(angle), -self.rise_m * np.arange(n)], 1)
        elif self.shape == "cloud":
            side = math.ceil(n ** (1 / 3) - 1e-9)
            k = np.arange(n)
            a, b, c = k // (side * side), k // side % side, k % side
            # every layer is shifted, so that no two agents stand exactly above one another
            d = self.spacing_m * np.stack([a + 0.31 * c, b + 0.17 * c, 1.0 * c], axis=1)
        elif self.shape in SHAPES:
            d = np.asarray(SHAPES[self.shape](n, self.spacing_m), dtype=float)
        else:
            raise ConfigError(f"formation.shape must be v, helix, cloud or one of {sorted(SHAPES)}, got {self.shape!r}")
        return np.asarray(d - d.mean(axis=0))


COMPILED_LAWS = ("flown", "intent")
Hold = Literal["zero", "first", "damped", "returning", "observer"]
Trigger = Literal["error", "switching", "periodic", "float clock", "classic", "elastic", "intent"]
Reading = Literal["V0", "V1", "V1b", "V2"]
Separation = Literal["cut", "gradient", "uncut", "attracting"]


@dataclass(frozen=True, slots=True)
class Setup:
    """Everything about a run but its seed. Defaults: ten vehicles in a V, calm, the flown law with study gains."""

    formation: Formation = Formation()
    velocity_m_s: tuple[float, float, float] = (1.0, 0.0, 0.0)
    turn_rad_s: float = 0.0
    """the plan's velocity turns at this rate; slots keep their directions"""
    legs: tuple[tuple[float, float, float], ...] = ()
    """(begin (s), angle (rad), how long (s)): there the plan's velocity turns by that angle besides, at one rate"""
    duration_s: float = 60.0
    dt_s: float = 0.01
    control_every: int = 1
    """steps per control period"""
    plan: bool = True
    """False: leaderless, the agents agree on the velocity that they start with"""
    informed: tuple[int, ...] = ()
    """leaderless agents that know the motion (velocity, turn, legs) and fly by it; nobody passes it on"""

    epsilon_nu_m_s: float = 0.03
    """leaderless: an estimate of the common velocity fires that is off by so much from what the peers make of it"""
    threat: tuple[float, ...] = ()
    """leaderless: begins (s), north, east (m from where the formation starts), velocity north, east (m/s), radius (m),
    lasts (s) of what is fled (`core.law.evasion`); empty: nothing"""

    start_ball_m: float = 0.5
    """agents start anywhere in a ball of this radius about their slots"""
    start_velocity_m_s: float = 0.1
    """and with the plan's velocity plus up to this much on each axis"""
    start_separation_m: float = 0.0
    """starts are drawn again until no two are closer than this (up to 300 agents)"""
    scrambled: bool = False
    """agents start at each other's slots, so that their paths cross"""

    law: str = "flown"
    """flown or intent, which are compiled; or a `law.kind` of fleet.toml, an installed package's too, of which each
    agent's plain `command` is called"""
    law_parameters: Mapping[str, Any] = field(default_factory=dict)
    """what [law] of fleet.toml says of such a kind, but for hold, damping, limit and range, which stand below"""
    hold: Hold = "damped"
    damping_s: float = 0.7
    k_s: float = 3.0
    k_a: float = 6.7
    k_c: float = 5.6
    k_v: float = 1.0
    k_p: float = 0.0
    r0_m: float = 1.2
    a_max_m_s2: float = 5.0
    saturation_m: float = 1.0
    saturation_m_s: float = 1.0
    normalise: bool = True
    reading: Reading = "V2"
    """which states enter Eq. (2): V0 own true, separation on true positions; V1 own last broadcast in alignment and
    cohesion; V1b own last broadcast everywhere; V2 own true, neighbours predicted everywhere (flown)"""
    separation: Separation = "cut"
    range_m: float = 100.0
    range_on_truth: bool = False
    nearest: int = 0
    """alignment and cohesion heed only the so many nearest by slot, and whoever has an agent among its own nearest, so
    that the graph is undirected; 0: everybody within range"""

    intent_k_p: float = 5.6
    intent_k_d: float = 7.7
    intent_c_g: float = 2.0
    intent_c_max: float = 1.0
    intent_kappa: float = 0.8
    intent_epsilon_m: float = 0.005

    trigger: Trigger = "error"
    epsilon_m: float = 0.2
    gamma_s2: float = 0.5
    kappa: float = 0.3
    t_min_s: float = 0.05
    t_max_s: float = 10.0
    period_s: float = 0.05
    period_spread: bool = False
    """agents' periods end at times of their own, as in flight, from a start that the seed draws; False: all at once"""
    near: bool = False
    """near mode (`core.trigger.near`), which needs the barrier"""
    near_period_s: float = 0.1
    count_start: bool = True
    send_filter: bool = True
    alpha: float = 0.1
    beta: float = 0.3
    delta_min: float = 0.01
    delta_f: float = 0.02
    eta: float = 0.3
    mode_by_residual: bool = False
    """switching: E_i read as the mean formation residual instead of |e_p| + |e_v|"""
    classic_sigma: float = 0.6
    classic_a: float = 0.3
    elastic_sigma: float = 0.1
    elastic_amplitude: float = 5.0
    elastic_rate: float = 0.4
    observer_gain: float = 2.0

    digest: int = 0
    """samples of peers in a message"""
    loss: float = 0.0
    """1: nothing that is sent arrives"""
    burst_s: float = 0.0
    """mean length of a link's outage; 0: losses are independent"""
    delay_s: float = 0.0

    gust_m_s2: float = 0.0
    gust_time_s: float = 1.0
    impulse_m_s2: float = 0.0
    impulse_probability: float = 0.0
    lag_s: float = 0.0
    push_agent: int = 0
    push_time_s: float = math.inf
    push_m_s: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """at push_time_s this is added to one agent's velocity"""
    disturbances: tuple[tuple[float, float, float, float, float, float, float], ...] = ()
    """(agent, from (s), to (s), share of its acceleration that it gets, push north, east, down (m/s^2))"""
    partitions: tuple[tuple[float, float, float], ...] = ()
    """(from (s), to (s), agent): meanwhile the agents below this one and the rest do not hear each other"""
    joins: tuple[tuple[float, float, float, float, float], ...] = ()
    """(agent, at (s), north, east, down (m)): it starts that far from its slot, flies along by the plan's velocity and
    takes part, heard and hearing, from then on"""
    sigma_p_m: float = 0.0
    sigma_p_time_s: float = 2.0
    sigma_v_m_s: float = 0.0

    barrier: bool = False
    barrier_radius_m: float = 0.9
    avoidance_max_m_s2: float = 8.0
    gates_after_s: float = math.inf
    fault: Literal["none", "vanish", "freeze"] = "none"
    fault_agent: int = 0
    fault_time_s: float = math.inf
    presence_delay_s: float = 1.5

    keep_every: int = 5
    """every how many steps the state is kept"""
    links: bool = False
    """keep what each receiver holds apart even though nothing is lost or late"""
    dense_measures: bool = True

    def __post_init__(self) -> None:
        _check(self.formation.count >= 2, "formation.count", self.formation.count, "at least 2")
        for name in ("duration_s", "dt_s", "damping_s", "r0_m", "a_max_m_s2", "saturation_m", "saturation_m_s",
                     "range_m", "t_max_s", "period_s", "gamma_s2", "gust_time_s", "sigma_p_time_s"):  # fmt: skip
            _check(getattr(self, name) > 0, name, getattr(self, name), "> 0")
        for name in ("start_ball_m", "start_velocity_m_s", "k_s", "k_a", "k_c", "k_v", "k_p", "epsilon_m", "kappa",
                     "t_min_s", "burst_s", "delay_s", "gust_m_s2", "impulse_m_s2", "lag_s", "sigma_p_m",
                     "sigma_v_m_s"):  # fmt: skip
            _check(0 <= getattr(self, name) < math.inf, name, getattr(self, name), ">= 0")
        _check(0 <= self.loss <= 1, "loss", self.loss, "in [0, 1]")
        _check(self.near_period_s > 0, "near_period_s", self.near_period_s, "> 0")
        _check(self.barrier or not self.near, "near", self.near, "false without the barrier, whose measure it is")
        for name, width in (("legs", 3), ("disturbances", 7), ("partitions", 3), ("joins", 5)):
            rows = getattr(self, name)
            _check(all(len(r) == width for r in rows), name, rows, f"rows of {width} numbers")
        n = self.formation.count
        agents = (*self.informed, *(d[0] for d in (*self.disturbances, *self.joins)))
        _check(all(a in range(n) for a in agents), "an agent", agents, f"one of 0..{n - 1}")
        _check(self.plan or not self.joins, "joins", self.joins, "empty without a plan, by which a joiner comes")
        _check(len(self.threat) in (0, 7), "threat", self.threat, "seven numbers, or none")
        _check(not (self.plan and self.threat), "threat", self.threat, "empty with a plan, which nobody leaves")
        _check(self.epsilon_nu_m_s > 0, "epsilon_nu_m_s", self.epsilon_nu_m_s, "> 0")
        _check(not (self.plan and self.informed), "informed", self.informed, "empty with a plan, which all know")
        _check(0 <= self.nearest < n <= DENSE_MAX or not self.nearest, "nearest", self.nearest,
               f"less than the agents, {DENSE_MAX} at most")  # fmt: skip
        _check(self.control_every >= 1, "control_every", self.control_every, "at least 1")
        _check(0 <= self.digest <= DIGEST_MAX, "digest", self.digest, f"in 0..{DIGEST_MAX}")
        self.law_table()
        if self.per_link and self.formation.count > DENSE_MAX:
            raise ConfigError(
                f"formation.count must be <= {DENSE_MAX} with loss, delay or digests (every pair has its own memory), "
                f"got {self.formation.count}"
            )

    def law_table(self) -> LawTable | None:
        """The table of a law whose plain `command` is called; None for a compiled one."""
        if self.law in COMPILED_LAWS:
            return None
        where = f"law = {self.law!r}"
        if LAWS.table(self.law) is None:
            known = dict.fromkeys((*COMPILED_LAWS, *LAWS.known()))
            raise ConfigError(f"law must be one of {', '.join(known)}, got {self.law!r}")
        if self.reading != "V2" or self.separation != "cut" or not self.plan:
            raise ConfigError(f"{where} flies a plan (plan = true) and knows one reading: reading V2, separation cut")
        shared = {
            "kind": self.law, "hold": self.hold, "hold_damping_s": self.damping_s, "a_max_m_s2": self.a_max_m_s2,
            "r0_m": self.r0_m,
        }  # fmt: skip
        if twice := shared.keys() & self.law_parameters:
            raise ConfigError(f"{where}: not under law_parameters but beside it: {', '.join(sorted(twice))}")
        values = {**shared, **self.law_parameters}
        try:
            return LAWS.validate(values)
        except ValidationError as error:
            faults = [sentence({**e, "loc": ("law", *e["loc"])}, {"law": values}) for e in error.errors()]
            raise ConfigError(f"{where}: {'; '.join(f.removeprefix('$.law.') for f in faults)}") from None

    @property
    def per_link(self) -> bool:
        """Whether receivers may hold different samples of one sender."""
        lossy = self.loss > 0 or self.delay_s > 0 or self.digest > 0
        return self.links or lossy or self.near or bool(self.partitions or self.joins)

    @property
    def uncertainty_m(self) -> float:
        """Of every prediction (m): the safety radius less what the filter adds itself."""
        return self.barrier_radius_m - COLLISION_DISTANCE_M - LAG_ALLOWANCE_M

    @property
    def peer_motion(self) -> PeerMotion:
        """What the agents must reckon with in each other (`core.monitor`)."""
        a_max = self.a_max_m_s2 if math.isfinite(self.a_max_m_s2) else 50.0
        cruise = math.hypot(*self.velocity_m_s) + self.start_velocity_m_s
        return PeerMotion(
            sigma_p_m=self.sigma_p_m, sigma_v_m_s=self.sigma_v_m_s,
            sigma_gust_m_s2=math.hypot(self.gust_m_s2, self.impulse_m_s2), a_max_m_s2=a_max,
            deviation_m_s2=2.0 * a_max, drift_m_s=cruise if self.hold == "zero" else 0.0, speed_m_s=math.inf,
            lag_s=self.lag_s if self.send_filter else 0.0, latency_s=self.control_every * self.dt_s + self.delay_s,
            t_min_s=self.t_min_s, t_max_s=self.t_max_s,
        )  # fmt: skip

    @property
    def error_bound_m(self) -> float:
        """Bound on |p_j - p^_j| while nothing is lost (m): the flown one of the trigger; none of a baseline's."""
        rules: Mapping[Trigger, rule.Trigger] = {
            "error": ErrorTrigger(self.epsilon_m, self.gamma_s2, self.kappa),
            "intent": ErrorTrigger(self.epsilon_m, self.gamma_s2, 0.0),
            "switching": SwitchingTrigger(self.gamma_s2, self.alpha, self.beta, self.delta_min, self.delta_f, self.eta),
            "periodic": PeriodicTrigger(self.period_s),
        }
        return rules[self.trigger].error_bound_m(self.peer_motion) if self.trigger in rules else math.inf


def _check(allowed: bool, name: str, value: object, text: str) -> None:
    if not allowed:
        raise ConfigError(f"{name} must be {text}, got {value}")


def setup_from(values: Mapping[str, Any], where: str, base: Setup | None = None) -> Setup:
    """A set-up from a table of a TOML file, unknown keys refused; what is not said stays as in `base`."""
    base = base or Setup()
    given = dict(values)
    formation = base.formation
    if "formation" in given:
        formation = _filled(formation, given.pop("formation"), f"{where}.formation")
    filled: Setup = _filled(base, given, where, formation=formation)
    return filled


def _filled(base: Any, values: Mapping[str, Any], where: str, **others: Any) -> Any:
    """`base` with a table's values, each checked, and with `others` as they are."""
    known = {f.name: f.type for f in fields(base)}
    for name, value in values.items():
        if name not in known:
            raise ConfigError(f"{where}.{name} is not a setting; known are {', '.join(sorted(known))}")
        kind = known[name]
        if get_origin(kind) is Literal and value not in get_args(kind):
            raise ConfigError(f"{where}.{name} must be one of {', '.join(get_args(kind))}, got {value!r}")
        if (
            (kind is bool) != isinstance(value, bool)
            or (kind is str and not isinstance(value, str))
            or (get_origin(kind) is Mapping) != isinstance(value, Mapping)
            or (kind in (int, float) and not isinstance(value, int | float))
            or (kind is int and not isinstance(value, int))
        ):
            raise ConfigError(f"{where}.{name} must be {getattr(kind, '__name__', kind)}, got {value!r}")
    return replace(base, **{name: _as(known[name], value) for name, value in values.items()}, **others)


def _as(kind: Any, value: Any) -> Any:
    """A TOML value as its setting keeps it: numbers with a fraction where it has one, lists as tuples."""
    if isinstance(value, list):
        return tuple(_as((*get_args(kind), float)[0], v) for v in value)
    return float(value) if kind is float else value


def connected(slots: Floats, range_m: float) -> bool:
    """Whether agents at their slots form one graph at this range."""
    n = len(slots)
    if n > DENSE_MAX:
        return True
    near = np.linalg.norm(slots[:, None] - slots[None, :], axis=2) <= range_m
    reached = np.zeros(n, dtype=bool)
    reached[0] = True
    for _ in range(n):
        reached = reached | near[reached].any(axis=0)
    return bool(reached.all())
