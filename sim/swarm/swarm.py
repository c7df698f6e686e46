"""A swarm of N double integrators (Eq. 1 of the paper) that runs the core's own law, compiled, over neighbour lists.

`Setup` says everything about a run; `run(setup, seed)` returns what happened. Every agent has its own random streams,
drawn from seed and index alone: the same seed gives the same disturbances, noise and losses whatever the law does, so
that laws are compared under equal luck. Up to 200 agents every ordered pair may be kept apart (loss, delay); above, a
sorted list of the neighbours within range, with a skin of 1 m, is rebuilt when relative motion has used the skin up,
and no array has N x N entries.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from functools import lru_cache
from types import ModuleType
from typing import Any, Literal, get_args, get_origin

import numpy as np
import numpy.typing as npt

from companion.core.formation import SHAPES
from companion.core.law.intent import IntentGains, IntentTrigger
from companion.core.law.starling import Gains
from companion.core.safety.filter import COLLISION_DISTANCE_M, LAG_ALLOWANCE_M
from companion.core.trigger.error import ErrorTrigger
from companion.core.trigger.switching import SwitchingTrigger
from companion.errors import ConfigError
from sim.swarm.state import MEASURES, ROW, SAMPLE, Floats, Ints, Options, State

DENSE_MAX = 200
"""up to here every ordered pair may have its own row"""
SKIN_M = 1.0
"""how much farther than the range the neighbour list reaches"""


def kernels() -> ModuleType:
    """The compiled loops; a sentence if what they need is not installed."""
    try:
        from sim.swarm import kernels as loops
    except ModuleNotFoundError as missing:
        raise ConfigError(
            f"studies need {missing.name}, which is not installed: pip install 'starling-fleet[study]'"
        ) from missing
    return loops


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


Law = Literal["flown", "intent"]
Hold = Literal["zero", "first", "damped", "observer"]
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
    duration_s: float = 60.0
    dt_s: float = 0.01
    control_every: int = 1
    """steps per control period"""
    plan: bool = True
    """False: leaderless, the agents agree on the velocity that they start with"""

    start_ball_m: float = 0.5
    """agents start anywhere in a ball of this radius about their slots"""
    start_velocity_m_s: float = 0.1
    """and with the plan's velocity plus up to this much on each axis"""
    start_separation_m: float = 0.0
    """starts are drawn again until no two are closer than this (up to 200 agents)"""
    scrambled: bool = False
    """agents start at each other's slots, so that their paths cross"""

    law: Law = "flown"
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
        _check(0 <= self.loss < 1, "loss", self.loss, "in [0, 1)")
        _check(self.control_every >= 1, "control_every", self.control_every, "at least 1")
        _check(0 <= self.digest <= 16, "digest", self.digest, "in 0..16")
        if self.per_link and self.formation.count > DENSE_MAX:
            raise ConfigError(
                f"formation.count must be <= {DENSE_MAX} with loss, delay or digests (every pair has its own memory), "
                f"got {self.formation.count}"
            )

    @property
    def per_link(self) -> bool:
        """Whether receivers may hold different samples of one sender."""
        return self.links or self.loss > 0 or self.delay_s > 0 or self.digest > 0

    @property
    def latency_s(self) -> float:
        """L of the error bound: control period, delay and t_min."""
        return self.control_every * self.dt_s + self.delay_s + self.t_min_s

    def error_bound_m(self) -> tuple[float, float]:
        """(slope, constant) of the bound on |p_j - p^_j| against the threshold epsilon in force (m).

        As `monitor.prediction_error_bound_m`, plus the send filter's own lag: under a constant unknown acceleration d
        the filter ends up d/11 behind in position and 2d/11 in velocity.
        """
        latency = self.latency_s
        unknown = 4 * self.gust_m_s2 + (self.a_max_m_s2 if self.lag_s > 0 else 0.0)
        behind = unknown * (1 + 2 * latency) / 11 if self.send_filter else 0.0
        a_max = self.a_max_m_s2 if math.isfinite(self.a_max_m_s2) else 50.0
        return (
            1 + latency / math.sqrt(self.gamma_s2),
            5.7 * self.sigma_p_m
            + latency * 5.7 * self.sigma_v_m_s
            + 0.5 * (2 * a_max + 4 * self.gust_m_s2) * latency**2
            + behind
            + 1e-9,
        )


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
    filled: Setup = _filled(base, given, where)
    return replace(filled, formation=formation)


def _filled(base: Any, values: Mapping[str, Any], where: str) -> Any:
    known = {f.name: f.type for f in fields(base)}
    for name, value in values.items():
        if name not in known:
            raise ConfigError(f"{where}.{name} is not a setting; known are {', '.join(sorted(known))}")
        kind = known[name]
        if get_origin(kind) is Literal and value not in get_args(kind):
            raise ConfigError(f"{where}.{name} must be one of {', '.join(get_args(kind))}, got {value!r}")
        if (kind is bool) != isinstance(value, bool) or (
            (kind in (int, float) and not isinstance(value, int | float))
            or (kind is int and not isinstance(value, int))
        ):
            raise ConfigError(f"{where}.{name} must be {getattr(kind, '__name__', kind)}, got {value!r}")
    converted = {
        name: float(value) if known[name] is float else tuple(map(float, value)) if isinstance(value, list) else value
        for name, value in values.items()
    }
    return replace(base, **converted)


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """What happened. T moments are kept, N agents."""

    setup: Setup
    seed: int
    time_s: Floats
    """(T,)"""
    position_m: Floats
    """(T, N, 3)"""
    velocity_m_s: Floats
    """(T, N, 3)"""
    command_m_s2: Floats
    """(T, N, 3)"""
    reference: Floats
    """(T, N, 6): p_ref,i of each slot and its velocity"""
    events: Ints
    """(messages, 2): step, agent"""
    messages: int
    samples_sent: int
    """own samples and digest entries together"""
    steps_dynamic: int
    steps_fixed: int
    """agent-steps in each mode of Eq. (5)"""
    filter_active: int
    """agent-steps in which the barrier changed a command"""
    measures: dict[str, float] = field(default_factory=dict)

    def healthy(self) -> npt.NDArray[np.bool_]:
        """Agents that did not fail."""
        alive = np.ones(self.position_m.shape[1], dtype=bool)
        if self.setup.fault != "none":
            alive[self.setup.fault_agent] = False
        return alive

    def formation_error_m(self) -> Floats:
        """Distance from the slot about the common centre, shape (T, healthy)."""
        offset = (self.position_m - self.reference[:, :, :3])[:, self.healthy()]
        return np.asarray(np.linalg.norm(offset - offset.mean(axis=1, keepdims=True), axis=2))

    def place_error_m(self) -> Floats:
        """Distance from the plan's slot, shape (T, healthy)."""
        return np.asarray(np.linalg.norm((self.position_m - self.reference[:, :, :3])[:, self.healthy()], axis=2))

    def velocity_error_m_s(self) -> Floats:
        """Velocity against the agents' mean, shape (T, healthy)."""
        v = self.velocity_m_s[:, self.healthy()]
        return np.asarray(np.linalg.norm(v - v.mean(axis=1, keepdims=True), axis=2))

    def rms_formation_m(self, after_s: float = 8.0) -> float:
        """F: RMS over agents and time of the formation error."""
        kept = self.formation_error_m()[self.time_s > after_s]
        return float(np.sqrt((kept**2).mean()))

    def intervals_s(self) -> Floats:
        """Times between two messages of one agent."""
        gaps = [
            np.diff(self.events[self.events[:, 1] == i, 0]) * self.setup.dt_s for i in range(self.position_m.shape[1])
        ]
        return np.concatenate(gaps) if gaps else np.zeros(0)

    def per_agent(self) -> Ints:
        """Messages of each agent, shape (N,)."""
        return np.bincount(self.events[:, 1], minlength=self.position_m.shape[1]).astype(np.int64)


def reference_table(setup: Setup, steps: int) -> Floats:
    """The plan's common motion, shape (steps, 1, 9): p (m), v (m/s), a (m/s^2) at each step; zeros without a plan."""
    t = np.arange(steps) * setup.dt_s
    table = np.zeros((steps, 1, 9))
    if not setup.plan:
        return table
    vx, vy, vz = setup.velocity_m_s
    rate = setup.turn_rad_s
    if rate == 0.0:
        table[:, 0, :3] = t[:, None] * np.array(setup.velocity_m_s)
        table[:, 0, 3:6] = setup.velocity_m_s
        return table
    s, c = np.sin(rate * t), np.cos(rate * t)
    table[:, 0, 0] = (vx * s - vy * (1 - c)) / rate
    table[:, 0, 1] = (vy * s + vx * (1 - c)) / rate
    table[:, 0, 2] = vz * t
    table[:, 0, 3], table[:, 0, 4], table[:, 0, 5] = vx * c - vy * s, vx * s + vy * c, vz
    table[:, 0, 6], table[:, 0, 7] = -rate * table[:, 0, 4], rate * table[:, 0, 3]
    return table


def starts(setup: Setup, seed: int) -> tuple[Floats, Floats]:
    """Positions and velocities at t = 0, shape (N, 3) each; every agent draws from its own stream."""
    slots = setup.formation.slots()
    n = len(slots)
    x, v = slots.copy(), np.tile(np.array(setup.velocity_m_s), (n, 1))
    if setup.scrambled:
        order = np.random.default_rng([seed, 10**6]).permutation(n)
        x = x[order]
    for i in range(n):
        rng = np.random.default_rng([seed, i])
        for _ in range(1000):
            direction = rng.normal(size=3)
            place = x[i] + setup.start_ball_m * rng.random() ** (1 / 3) * direction / np.linalg.norm(direction)
            if setup.start_separation_m <= 0.0 or i == 0:
                break
            if np.linalg.norm(x[:i] - place, axis=1).min() >= setup.start_separation_m:
                break
        x[i] = place
        v[i] += setup.start_velocity_m_s * rng.uniform(-1, 1, size=3)
    return x, v


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


_HOLDS = {"zero": 0, "first": 1, "damped": 2, "observer": 3}
_TRIGGERS = {"error": 0, "switching": 1, "periodic": 2, "float clock": 3, "classic": 4, "elastic": 5, "intent": 6}
_SEPARATIONS = {"cut": 0, "attracting": 0, "gradient": 1, "uncut": 2}


def gains(setup: Setup) -> Gains:
    """The law's gains; the literal sign of the printed separation is a negative k_s."""
    k_s = -setup.k_s if setup.separation == "attracting" else setup.k_s
    return Gains(
        k_s, setup.k_a, setup.k_c, setup.k_v, setup.k_p, setup.r0_m, setup.a_max_m_s2, setup.saturation_m,
        setup.saturation_m_s, 1.0 if setup.normalise else 0.0,
    )  # fmt: skip


def run_options(setup: Setup) -> Any:
    """The set-up as the kernels' plain numbers."""
    slope, constant = setup.error_bound_m()
    own_held = setup.reading in ("V1", "V1b")
    elastic = setup.trigger == "elastic"
    fault = setup.fault != "none"
    return Options(
        dt=setup.dt_s,
        dt_ns=round(setup.dt_s * 1e9),
        every=setup.control_every,
        hold=_HOLDS[setup.hold],
        damping=setup.damping_s,
        trigger=_TRIGGERS[setup.trigger],
        t_min=setup.t_min_s,
        t_max=setup.t_max_s,
        period=setup.period_s,
        period_ns=max(round(setup.period_s * 1e9), 1),
        mode_by_residual=int(setup.mode_by_residual),
        count_start=int(setup.count_start),
        leaderless=int(not setup.plan),
        intent=int(setup.law == "intent"),
        own_held=int(own_held),
        separation_on_truth=int(setup.reading in ("V0", "V1")),
        separation_kind=_SEPARATIONS[setup.separation],
        range_m=setup.range_m,
        range_on_truth=int(setup.range_on_truth),
        send_filter=int(setup.send_filter),
        links=int(setup.per_link),
        delay=math.ceil(setup.delay_s / (setup.dt_s * setup.control_every) - 1e-9),
        loss=setup.loss,
        burst=setup.burst_s,
        digest=min(setup.digest, setup.formation.count - 1),
        gates_after=setup.gates_after_s,
        barrier=int(setup.barrier),
        uncertainty=setup.barrier_radius_m - COLLISION_DISTANCE_M - LAG_ALLOWANCE_M,
        avoidance_max=setup.avoidance_max_m_s2,
        sigma_p=setup.sigma_p_m,
        sigma_p_time=setup.sigma_p_time_s,
        sigma_v=setup.sigma_v_m_s,
        gust=setup.gust_m_s2,
        gust_time=setup.gust_time_s,
        impulse=setup.impulse_m_s2,
        impulse_probability=setup.impulse_probability,
        lag=setup.lag_s,
        push_agent=setup.push_agent,
        push_step=round(setup.push_time_s / setup.dt_s) if math.isfinite(setup.push_time_s) else -1,
        push_x=setup.push_m_s[0],
        push_y=setup.push_m_s[1],
        push_z=setup.push_m_s[2],
        relative_sigma=setup.elastic_sigma if elastic else setup.classic_sigma,
        relative_a=setup.elastic_rate if elastic else setup.classic_a,
        elastic_amplitude=setup.elastic_amplitude,
        observer_gain=setup.observer_gain,
        fault_agent=setup.fault_agent if fault else -1,
        fault_step=round(setup.fault_time_s / setup.dt_s) if fault else 2**40,
        fault_frozen=round(0.5 / setup.dt_s) if setup.fault == "freeze" else 0,
        presence_delay=setup.presence_delay_s,
        bound_slope=slope,
        bound_constant=constant,
        dense_measures=int(setup.dense_measures and setup.formation.count <= DENSE_MAX),
    )


@lru_cache(maxsize=4)
def agent_keys(seed: int, count: int) -> npt.NDArray[np.uint64]:
    """Each agent's own random streams, shape (count, 8)."""
    return np.stack([np.random.SeedSequence([seed, i]).generate_state(8, np.uint64) for i in range(count)])


class NeighbourList:
    """Who is near whom: compressed rows within range and skin, rebuilt once relative motion has used up the skin."""

    def __init__(self, range_m: float) -> None:
        self.range_m = range_m
        self.start: Ints = np.zeros(1, dtype=np.int64)
        self.column: Ints = np.zeros(0, dtype=np.int64)
        self.rebuilt = 0
        self._then: Floats | None = None

    def update(self, x: Floats) -> bool:
        """Make the list good for positions x, shape (N, 3); returns whether it had to be rebuilt."""
        kernels()
        from sim.swarm import grid

        if self._then is not None and grid.largest_shift(x, self._then) <= SKIN_M / 2:
            return False
        reach = self.range_m + SKIN_M
        low = x.min(axis=0)
        shape = np.maximum(((x.max(axis=0) - low) / reach).astype(np.int64), 1)
        # few huge cells or many empty ones: both are bounded
        shape = np.minimum(shape, 200)
        width = float(max(((x.max(axis=0) - low) / shape).max(), reach))
        count = np.zeros(int(shape.prod()) + 1, dtype=np.int64)
        cell = np.zeros(len(x), dtype=np.int64)
        order = np.zeros(len(x), dtype=np.int64)
        grid.cells(x, low, width, shape, cell, count, order)
        self.start = np.zeros(len(x) + 1, dtype=np.int64)
        column = self.column if self.column.size else np.zeros(64 * len(x), dtype=np.int64)
        while True:
            needed = grid.listed(x, low, width, shape, count, order, reach, self.start, column)
            if needed <= column.size:
                break
            column = np.zeros(int(needed * 1.1), dtype=np.int64)
        self.column = column
        self._then = x.copy()
        self.rebuilt += 1
        return True

    def sorted_order(self, x: Floats) -> Ints:
        """Agents by cell: positions in this order keep neighbours in space close in memory."""
        cell = np.floor((x - x.min(axis=0)) / (self.range_m / 2)).astype(np.int64)
        return np.lexsort((cell[:, 2], cell[:, 1], cell[:, 0])).astype(np.int64)

    def within_range(self, x: Floats) -> float:
        """Mean number of neighbours within the range itself, without the skin."""
        owner = np.repeat(np.arange(len(x)), np.diff(self.start))
        near = np.linalg.norm(x[owner] - x[self.column[: self.start[-1]]], axis=1) <= self.range_m
        return float(near.sum() / len(x))


def rules_of(setup: Setup) -> tuple[Gains, IntentGains, ErrorTrigger, SwitchingTrigger, IntentTrigger]:
    """Gains and thresholds of every law and trigger, as the kernels take them."""
    return (
        gains(setup),
        IntentGains(
            setup.intent_k_p, setup.intent_k_d, setup.intent_c_g, setup.intent_c_max, setup.saturation_m,
            setup.saturation_m_s,
        ),
        ErrorTrigger(setup.epsilon_m, setup.gamma_s2, setup.kappa),
        SwitchingTrigger(setup.gamma_s2, setup.alpha, setup.beta, setup.delta_min, setup.delta_f, setup.eta),
        IntentTrigger(setup.intent_epsilon_m, setup.intent_kappa),
    )  # fmt: skip


def with_list(s: Any, near: NeighbourList) -> Any:
    """The state with a neighbour list that is good for its positions, and room for as many neighbours."""
    if not near.update(s.x):
        return s
    width = int(np.diff(near.start).max()) + 1
    return s._replace(start=near.start, column=near.column, **_room(width))


def _room(width: int) -> dict[str, Any]:
    """Where one agent's neighbours are laid out."""
    return {
        "near": np.zeros((width, ROW)), "near_row": np.zeros(width, dtype=np.int64),
        "planes": np.zeros((width, 5)), "spare": np.zeros((width, 3)), "scratch": np.zeros((2, width)),
    }  # fmt: skip


def state_of(
    setup: Setup, seed: int, o: Any, table: Floats, x: Floats, v: Floats, slots: Floats, near: "NeighbourList | None"
) -> Any:
    """The kernels' state at the start; every pair is listed where no neighbour list is given."""
    n = len(x)
    steps = round(setup.duration_s / setup.dt_s)
    start = np.arange(n + 1, dtype=np.int64) * (n - 1)
    if near is None:
        column = np.array([j for i in range(n) for j in range(n) if j != i], dtype=np.int64)
    else:
        near.update(x)
        start, column = near.start, near.column
    rows = n * (n - 1) if o.links else n
    kept = -(-steps // setup.keep_every)
    depth = o.delay + 1 if o.links else 1
    ring_digest = max(o.digest, 1)
    s = State(
        x=x, v=v, a=np.zeros((n, 3)), gust=np.zeros((n, 3)), bias=np.zeros((n, 3)), measured=np.zeros((n, 6)),
        filtered=np.zeros((n, 6)), u=np.zeros((n, 3)), common=np.zeros((n, 3)), anchor=np.zeros((n, 3)),
        anchor_speed=np.zeros((n, 3)), sent=np.zeros((n, SAMPLE)), sent_step=np.full(n, -1, dtype=np.int64),
        limit=np.zeros(n), clock=np.zeros(n), own=np.zeros((n, 12)), residual=np.zeros((n, 3)), neighbours=np.zeros(n),
        observed=np.zeros((n, 6)), predicted=np.zeros((rows, 12)),
        held=np.zeros((rows if o.links else 1, SAMPLE)),
        held_step=np.full(rows if o.links else 1, -1, dtype=np.int64), stopped=np.zeros((rows, 3)),
        offset=np.ascontiguousarray(slots), slot=np.zeros((n, 3)),
        start=start, column=column,
        ring=np.zeros((depth, n if o.links else 1, SAMPLE)),
        ring_step=np.full((depth, n), -1, dtype=np.int64),
        ring_digest=np.zeros((depth, n if o.links else 1, ring_digest, SAMPLE)),
        ring_digest_step=np.zeros((depth, n if o.links else 1, ring_digest), dtype=np.int64),
        ring_digest_id=np.full((depth, n if o.links else 1, ring_digest), -1, dtype=np.int64),
        outage=np.zeros(rows, dtype=np.uint8), keys=agent_keys(seed, n),
        **_room(int(np.diff(start).max()) + 1),
        measures=np.array([1e9, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]),
        events=np.zeros((n * (steps // setup.control_every + 1), 2), dtype=np.int64),
        counts=np.zeros(5, dtype=np.int64), record=np.zeros((kept, n, 6)), record_u=np.zeros((kept, n, 3)),
    )  # fmt: skip
    _start_estimates(s, setup, table, o)
    return s


def run(setup: Setup, seed: int, *, reference: Floats | None = None, start: tuple[Floats, Floats] | None = None) -> Run:
    """Fly one set-up under one seed. `reference`, shape (steps, 1 or N, 9), replaces the plan's table."""
    if not connected(setup.formation.slots(), setup.range_m):
        raise ConfigError(
            f"the formation is not connected at range_m = {setup.range_m} m: raise range_m or bring the slots closer"
        )
    loops = kernels()
    n = setup.formation.count
    steps = round(setup.duration_s / setup.dt_s)
    table = reference_table(setup, steps + 1) if reference is None else reference
    x, v = starts(setup, seed) if start is None else (start[0].copy(), start[1].copy())
    slots = setup.formation.slots() if table.shape[1] == 1 else np.zeros((n, 3))
    o, rules = run_options(setup), rules_of(setup)
    near = None if n <= DENSE_MAX else NeighbourList(setup.range_m)
    s = state_of(setup, seed, o, table, x, v, slots, near)
    if near is None:
        loops.advance(0, steps, setup.keep_every, s, table, o, *rules)
    else:
        for k in range(steps):
            s = with_list(s, near)
            loops.advance(k, k + 1, setup.keep_every, s, table, o, *rules)
    if s.counts[0] > len(s.events):
        raise RuntimeError(f"{s.counts[0]} events, room for {len(s.events)}")
    kept = len(s.record)
    kept_steps = np.arange(kept) * setup.keep_every
    centre = np.broadcast_to(table[kept_steps], (kept, n, 9))
    place = centre[:, :, :6].copy()
    place[:, :, :3] += slots
    return Run(
        setup=setup,
        seed=seed,
        time_s=np.asarray(kept_steps * setup.dt_s, dtype=np.float64),
        position_m=s.record[:, :, :3],
        velocity_m_s=s.record[:, :, 3:],
        command_m_s2=s.record_u,
        reference=place,
        events=s.events[: s.counts[0]].copy(),
        messages=int(s.counts[0]),
        samples_sent=int(s.counts[1]),
        steps_dynamic=int(s.counts[2]),
        steps_fixed=int(s.counts[3]),
        filter_active=int(s.counts[4]),
        measures=dict(zip(MEASURES, map(float, s.measures), strict=True)),
    )


def _start_estimates(s: Any, setup: Setup, table: Floats, o: Any) -> None:
    """Gusts and sensor errors start in their stationary state, estimates at the first measurement."""
    n = setup.formation.count
    for i in range(n):
        rng = np.random.default_rng([setup_salt(i), int(s.keys[i, 0] >> np.uint64(1))])
        s.gust[i] = setup.gust_m_s2 * rng.normal(size=3)
        s.bias[i] = setup.sigma_p_m * rng.normal(size=3)
        first = s.v[i] + setup.sigma_v_m_s * rng.normal(size=3)
        if not setup.plan:
            s.common[i] = first
    s.anchor[:] = s.x + s.bias - table[0, :, :3] - s.offset
    if not setup.count_start:
        # the paper: everyone knows everyone's start
        s.sent[:, :3], s.sent[:, 3:6] = s.x, s.v
        s.sent_step[:] = 0
        s.limit[:] = setup.t_max_s
        if o.links:
            s.held[:] = s.sent[s.column]
            s.held_step[:] = 0


def setup_salt(agent: int) -> int:
    """Keeps an agent's first draws apart from its later streams."""
    return 7_000_003 + agent
