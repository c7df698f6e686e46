"""A swarm of N double integrators (Eq. 1 of the paper) that runs the core's own law, compiled, over neighbour lists.

`Setup` says everything about a run; `run(setup, seed)` returns what happened. Every agent has its own random streams,
drawn from seed and index alone: the same seed gives the same disturbances, noise and losses whatever the law does, so
that laws are compared under equal luck. Up to 300 agents every ordered pair may be kept apart (loss, delay); above, a
sorted list of the neighbours within range, with a skin of 1 m, is rebuilt when relative motion has used the skin up,
and no array has N x N entries.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache
from types import ModuleType
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from companion.core.law.base import FIELDS_MAX
from companion.core.law.evasion import NO_THREAT, UNDISTURBED
from companion.errors import ConfigError
from companion.vehicle.publisher import CLOCK_SHIFT_NS
from sim.swarm.neighbour_list import NeighbourList
from sim.swarm.options import linked_pairs, near_uncertainty_m, rules_of, run_options
from sim.swarm.setup import DENSE_MAX, Setup, connected
from sim.swarm.state import CAUSES, ERROR_BIN_M, ERROR_BINS, MEASURES, ROW, SAMPLE, Floats, Ints, State


def kernels() -> ModuleType:
    """The compiled loops; a sentence if what they need is not installed."""
    try:
        from sim.swarm import kernels as loops
    except ModuleNotFoundError as missing:
        raise ConfigError(
            f"studies need {missing.name}, which is not installed: pip install 'starling-fleet[study]'"
        ) from missing
    return loops


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
    reference: Floats
    """(T, N, 6): p_ref,i of each slot and its velocity"""
    events: Ints
    """(messages, 3): step, agent, cause (an index of `state.CAUSES`)"""
    messages: int
    samples_sent: int
    """own samples and digest entries together"""
    steps_dynamic: int
    steps_fixed: int
    """agent-steps in each mode of Eq. (5)"""
    measures: dict[str, float] = field(default_factory=dict)
    error_bins: Ints = field(default_factory=lambda: np.zeros(ERROR_BINS, dtype=np.int64))
    """how many predictions were wrong by so many millimetres"""
    received: int = 0
    """how often a message reached a receiver, where receivers hold samples of their own"""
    common: Floats = field(default_factory=lambda: np.zeros((0, 0, 4)))
    """(T, N, 4): nu, and what each agent does about a threat (`core.law.evasion`); empty where nothing is fled"""

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

    def intervals_s(self) -> Floats:
        """Times between two messages of one agent."""
        gaps = [
            np.diff(self.events[self.events[:, 1] == i, 0]) * self.setup.dt_s for i in range(self.position_m.shape[1])
        ]
        return np.concatenate(gaps) if gaps else np.zeros(0)

    def per_agent(self) -> Ints:
        """Messages of each agent, shape (N,)."""
        return np.bincount(self.events[:, 1], minlength=self.position_m.shape[1]).astype(np.int64)

    def by_cause(self) -> dict[str, int]:
        """How many messages were sent for which of `state.CAUSES`."""
        counted = np.bincount(self.events[:, 2], minlength=len(CAUSES))
        return {cause: int(n) for cause, n in zip(CAUSES, counted, strict=True)}


def quantile_m(error_bins: Ints, share: float) -> float:
    """The error that this share of all predictions does not exceed (m), to a bin's width."""
    total = np.cumsum(error_bins)
    return ERROR_BIN_M * (int(np.searchsorted(total, share * total[-1])) + 1)


def reference_table(setup: Setup, steps: int) -> Floats:
    """What all know of the common motion, shape (steps, 1, 9), as `motion_table`; zeros without a plan."""
    return motion_table(setup, steps) if setup.plan else np.zeros((steps, 1, 9))


def motion_table(setup: Setup, steps: int) -> Floats:
    """The common motion, shape (steps, 1, 9): p (m), v (m/s), a (m/s^2) at each step."""
    t = np.arange(steps) * setup.dt_s
    table = np.zeros((steps, 1, 9))
    vx, vy, vz = setup.velocity_m_s
    rate = setup.turn_rad_s
    if setup.legs:
        heading, turning = rate * t, np.full(steps, rate)
        for begin_s, angle_rad, over_s in setup.legs:
            heading = heading + angle_rad * np.clip((t - begin_s) / over_s, 0.0, 1.0)
            turning = turning + np.where((t >= begin_s) & (t < begin_s + over_s), angle_rad / over_s, 0.0)
        s, c = np.sin(heading), np.cos(heading)
        v = np.stack([vx * c - vy * s, vx * s + vy * c, np.full(steps, vz)], axis=1)
        table[:, 0, 3:6] = v
        table[:, 0, 6], table[:, 0, 7] = -turning * v[:, 1], turning * v[:, 0]
        table[1:, 0, :3] = np.cumsum(0.5 * setup.dt_s * (v[1:] + v[:-1]), axis=0)
        return table
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
    for agent, _, *aside in setup.joins:
        x[int(agent)] += aside
    return x, v


def _phases_ns(setup: Setup, seed: int) -> Ints:
    """By how much each agent's periods and near mode's end earlier than the run's own, shape (count, 2)."""
    place = np.arange(setup.formation.count)
    phases = np.zeros((setup.formation.count, 2), dtype=np.int64)
    phases[:, 1] = CLOCK_SHIFT_NS * place
    if setup.period_spread:
        first = np.random.default_rng([seed, 10**6 + 1]).random()
        phases[:, 0] = np.round((first + CLOCK_SHIFT_NS * 1e-9 * place) % 1.0 * setup.period_s * 1e9)
    return phases


@lru_cache(maxsize=4)
def agent_keys(seed: int, count: int) -> npt.NDArray[np.uint64]:
    """Each agent's own random streams, shape (count, 8)."""
    return np.stack([np.random.SeedSequence([seed, i]).generate_state(8, np.uint64) for i in range(count)])


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
    talks = n if o.near else 0
    motion = motion_table(setup, steps + 1)[:, 0, 3:]
    informed, joined = np.zeros(n, dtype=np.uint8), np.zeros(n, dtype=np.int64)
    informed[list(setup.informed)] = 1
    for agent, at_s, *_ in setup.joins:
        joined[int(agent)] = round(at_s / setup.dt_s)
    s = State(
        x=x, v=v, a=np.zeros((n, 3)), gust=np.zeros((n, 3)), bias=np.zeros((n, 3)), measured=np.zeros((n, 6)),
        filtered=np.zeros((n, 6)), u=np.zeros((n, 3)), common=np.zeros((n, 3)), common_rate=np.zeros((n, 3)),
        evasion=np.zeros((n, len(UNDISTURBED))), threat=np.array(setup.threat[1:] or NO_THREAT, dtype=float),
        anchor=np.zeros((n, 3)),
        anchor_speed=np.zeros((n, 3)), sent=np.zeros((n, SAMPLE)), sent_step=np.full(n, -1, dtype=np.int64),
        limit=np.zeros(n), clock=np.zeros(n), own=np.zeros((n, 12)), residual=np.zeros((n, 3)), neighbours=np.zeros(n),
        told=np.zeros((n, FIELDS_MAX)),
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
        measures=np.array([1e9, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]), error_bins=np.zeros(ERROR_BINS, dtype=np.int64),
        phase_ns=_phases_ns(setup, seed), informed=informed, wish=np.ascontiguousarray(motion),
        linked=linked_pairs(setup), joined=joined,
        disturbances=np.array([
            (agent, round(a / setup.dt_s), b / setup.dt_s, *rest) for agent, a, b, *rest in setup.disturbances
        ], dtype=float).reshape(-1, 7),
        partitions=np.array([
            (round(a / setup.dt_s), round(b / setup.dt_s), int(below)) for a, b, below in setup.partitions
        ], dtype=np.int64).reshape(-1, 3),
        missing=near_uncertainty_m(setup), near_until=np.zeros(rows if o.near else 0, dtype=np.int64),
        named_until=np.zeros(n, dtype=np.int64), promised=np.zeros(n, dtype=np.uint8),
        held_due=np.zeros(rows if o.near else 0, dtype=np.uint8), ring_due=np.zeros((depth, n), dtype=np.uint8),
        ring_near=np.zeros((depth, talks, talks), dtype=np.uint8),
        events=np.zeros((n * (steps // setup.control_every + 1), 3), dtype=np.int64),
        counts=np.zeros(5, dtype=np.int64), record=np.zeros((kept, n, 6)),
        record_common=np.zeros((kept if setup.threat else 0, n, 4)),
    )  # fmt: skip
    _start_estimates(s, setup, table, o)
    return s


def _advance(setup: Setup) -> Callable[..., None]:
    """What takes the agents on by some steps: the compiled loop, or the one that calls plain laws."""
    loops = kernels()
    table = setup.law_table()
    if table is None:
        return cast(Callable[..., None], loops.advance)
    from sim.swarm.plain_law import PlainLaws

    return PlainLaws(table, setup.formation.count, setup.r0_m).advance


def run(setup: Setup, seed: int, *, reference: Floats | None = None, start: tuple[Floats, Floats] | None = None) -> Run:
    """Fly one set-up under one seed. `reference`, shape (steps, 1 or N, 9), replaces the plan's table."""
    if not connected(setup.formation.slots(), setup.range_m):
        raise ConfigError(
            f"the formation is not connected at range_m = {setup.range_m} m: raise range_m or bring the slots closer"
        )
    advance = _advance(setup)
    n = setup.formation.count
    steps = round(setup.duration_s / setup.dt_s)
    table = reference_table(setup, steps + 1) if reference is None else reference
    x, v = starts(setup, seed) if start is None else (start[0].copy(), start[1].copy())
    slots = setup.formation.slots() if table.shape[1] == 1 else np.zeros((n, 3))
    o, rules = run_options(setup), rules_of(setup)
    near = None if n <= DENSE_MAX else NeighbourList(setup.range_m)
    s = state_of(setup, seed, o, table, x, v, slots, near)
    if near is None:
        advance(0, steps, setup.keep_every, s, table, o, *rules)
    else:
        for k in range(steps):
            s = with_list(s, near)
            advance(k, k + 1, setup.keep_every, s, table, o, *rules)
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
        reference=place,
        events=s.events[: s.counts[0]].copy(),
        messages=int(s.counts[0]),
        samples_sent=int(s.counts[1]),
        steps_dynamic=int(s.counts[2]),
        steps_fixed=int(s.counts[3]),
        measures=dict(zip(MEASURES, map(float, s.measures), strict=True)),
        error_bins=s.error_bins,
        received=int(s.counts[4]),
        common=s.record_common,
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
            s.evasion[i, 5:7] = first[:2]
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
