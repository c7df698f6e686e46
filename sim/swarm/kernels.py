"""The core's own functions, compiled, and the loops around them. Imported only once numba is wanted.

Law, safety filter, prediction, triggers and gates are those of `companion.core`, compiled as they are; this file holds
the loops, the network, the noise and the double integrators. Arrays say their shape in `State`; N agents, R rows (a row
is what one receiver holds of one sender: R = N while nothing is lost or late, else one for each ordered pair).

What flies besides in a vehicle, and is left out here: the fence, the limits on jerk and speed, the altitude with its
own loop and limits (the law acts in all three dimensions here), the bias observer, near mode, what a peer does on the
ground or under its pilot, the growth of a lost peer's uncertainty. Sums over neighbours are rounded after each term,
once in a vehicle: commands differ by less than 1e-9 of what is summed.
"""

# ruff: noqa: PLR1714 - chained comparisons compile to simpler code than membership tests
import math
from collections.abc import Callable
from hashlib import blake2s
from pathlib import Path
from types import FunctionType
from typing import Any, NamedTuple, TypeVar, cast

import numba
import numpy as np
import numpy.typing as npt
from numba import config as numba_config

from companion.core import estimate, values, vectors
from companion.core import prediction as hold
from companion.core.frames import Ned
from companion.core.law import consensus, intent
from companion.core.law import starling as law
from companion.core.law.intent import IntentGains, IntentTrigger
from companion.core.law.starling import Gains, Sums
from companion.core.neighbours import gates
from companion.core.prediction import Weights
from companion.core.safety import filter as safety
from companion.core.safety import program
from companion.core.trajectory.fleet import Reference
from companion.core.trigger import error, periodic, switching
from companion.core.trigger.error import ErrorTrigger
from companion.core.trigger.switching import SwitchingTrigger
from companion.core.values import Neighbour, VehicleState
from sim.swarm import baselines
from sim.swarm.baselines import CUT

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Flags = npt.NDArray[np.uint8]
F = TypeVar("F", bound=Callable[..., Any])

_MODULES = (
    baselines, consensus, error, estimate, gates, hold, intent, law, periodic, program, safety, switching, values,
    vectors,
)  # fmt: skip


def source_hash() -> str:
    """A digest of every file that these kernels are made of: names their compiled code and the results made by it."""
    digest = blake2s(digest_size=8)
    for path in [*(Path(str(m.__file__)) for m in _MODULES), Path(__file__)]:
        digest.update(path.read_bytes())
    return digest.hexdigest()


# numba's disk cache looks only at the file of the outermost function; a changed law must not find an old kernel.
numba_config.CACHE_DIR = str(
    Path(numba_config.CACHE_DIR or Path.home() / ".cache" / "starling-fleet") / f"kernels-{source_hash()}"
)

FAST = {"nsz", "contract", "reassoc", "arcp", "afn", "nnan"}
"""numbers are finite here and their order of summation is free; infinite limits stay meaningful"""


def compiled(function: F, **names: Any) -> F:
    """A core function, compiled; `names` stand for the functions that it calls."""
    bound = FunctionType(function.__code__, {**function.__globals__, **names}, function.__name__, function.__defaults__)
    return cast(F, numba.njit(fastmath=FAST)(bound))


def kernel(function: F) -> F:
    """A function of this file, compiled and kept on disk."""
    return cast(F, numba.njit(cache=True, fastmath=FAST, error_model="numpy")(function))


def inlined(function: F) -> F:
    """A part of a kernel that is called for each agent: a call would hand over, and count, every array of the state."""
    return cast(F, numba.njit(fastmath=FAST, error_model="numpy", inline="always")(function))


_share = compiled(law._share)
within_budget = compiled(law.within_budget, _share=_share)
pair = compiled(law.pair)
separation = compiled(law.separation, pair=pair)
share = compiled(law.share, pair=pair, separation=separation)
combine = compiled(law.combine, within_budget=within_budget)
mean_residual = compiled(law.mean_residual)
damped = compiled(hold.damped)
zero = compiled(hold.zero)
first = compiled(hold.first)
axis = compiled(hold.axis)
exceeds = compiled(error.exceeds)
switching_threshold = compiled(switching.switching_threshold)
switching_exceeds = compiled(switching.switching_exceeds, switching_threshold=switching_threshold)
period_ended = compiled(periodic.period_ended)
alpha_beta = compiled(estimate.alpha_beta)
closest_point_parameter = compiled(vectors.closest_point_parameter)
lerp = compiled(vectors.lerp)
safety_radius_m = compiled(safety.safety_radius_m)
barrier = compiled(safety.barrier)
nearest_hypothesis = compiled(safety.nearest_hypothesis, closest_point_parameter=closest_point_parameter, lerp=lerp)
_across_segment = compiled(safety._across_segment, closest_point_parameter=closest_point_parameter)
half_plane = compiled(
    safety.half_plane, nearest_hypothesis=nearest_hypothesis, _across_segment=_across_segment,
    safety_radius_m=safety_radius_m, barrier=barrier,
)  # fmt: skip
out_of_reach = compiled(safety.out_of_reach, safety_radius_m=safety_radius_m)
on_edge = compiled(program.on_edge)
best = compiled(program.best, on_edge=on_edge)
give_way = compiled(program.give_way, best=best)
solve = compiled(program.solve, best=best, give_way=give_way)
sidestep = compiled(safety.sidestep)
avoid: Callable[[float, float, float, float, Floats, int, int, float, Floats], safety.Avoidance] = compiled(
    cast(Any, safety.avoid), sidestep=sidestep, solve=solve
)
is_outlier = compiled(gates.is_outlier)
saturated = compiled(consensus.saturated)
common_velocity_rate = compiled(consensus.common_velocity_rate)
anchor_rate = compiled(intent.anchor_rate, saturated=saturated)
intent_rest = compiled(intent.rest, saturated=saturated)
response = compiled(intent.response)
anchor_axis = compiled(intent.anchor_axis)
anchor_exceeds = compiled(intent.anchor_exceeds)
classic_threshold = compiled(baselines.classic_threshold)
elastic_threshold = compiled(baselines.elastic_threshold)
observer_axis = compiled(baselines.observer_axis)
other_separation = compiled(baselines.other_separation)

HOLD_ZERO, HOLD_FIRST, HOLD_DAMPED, HOLD_OBSERVER = 0, 1, 2, 3
ERROR, SWITCHING, PERIODIC, FLOAT_CLOCK, CLASSIC, ELASTIC, INTENT = 0, 1, 2, 3, 4, 5, 6
SAMPLE = 15
"""floats of a sample: flown law p, v, nu; published intent c, g, w, e, e'"""
DIGEST = 16
"""most samples of peers that a message carries"""
NEVER = -1


class Options(NamedTuple):
    """What a run is, as plain numbers (metres, seconds, m/s, m/s^2)."""

    dt: float
    dt_ns: int
    every: int
    """steps per control period"""
    hold: int
    damping: float
    trigger: int
    t_min: float
    t_max: float
    period: float
    period_ns: int
    mode_by_residual: int
    """1: E_i of Eq. (5) is read as the mean formation residual instead of the estimation error"""
    count_start: int
    """1: the first message is a message; 0: the start is known to all (the paper)"""
    leaderless: int
    intent: int
    own_held: int
    """1: the own state in the law is the own last broadcast (reading V1, V1b)"""
    separation_on_truth: int
    separation_kind: int
    range_m: float
    range_on_truth: int
    send_filter: int
    links: int
    """1: what each receiver holds of each sender is kept apart (loss, delay)"""
    delay: int
    """control periods from sending to arrival"""
    loss: float
    burst: float
    """mean length of a link's outage (s); 0: losses are independent"""
    digest: int
    gates_after: float
    barrier: int
    uncertainty: float
    """of every prediction (m): the safety radius less what the filter adds itself"""
    avoidance_max: float
    sigma_p: float
    sigma_p_time: float
    sigma_v: float
    gust: float
    gust_time: float
    impulse: float
    impulse_probability: float
    lag: float
    push_agent: int
    push_step: int
    push_x: float
    push_y: float
    push_z: float
    relative_sigma: float
    """classic trigger: gamma_1; elastic: observer threshold coefficient"""
    relative_a: float
    """classic trigger: gamma_2; elastic: rate of decay"""
    elastic_amplitude: float
    observer_gain: float
    fault_agent: int
    fault_step: int
    fault_frozen: int
    """steps for which the failing vehicle's measurements stand still before it falls silent"""
    presence_delay: float
    bound_slope: float
    bound_constant: float
    dense_measures: int
    """1: minimum distance and prediction errors are measured at every step"""


class State(NamedTuple):
    """Everything that a run changes."""

    x: Floats
    """true position (N, 3)"""
    v: Floats
    """true velocity (N, 3)"""
    a: Floats
    """acceleration behind the actuator's lag (N, 3)"""
    gust: Floats
    bias: Floats
    """correlated error of measured position (N, 3)"""
    measured: Floats
    """(N, 6)"""
    filtered: Floats
    """(N, 6)"""
    u: Floats
    """command of the last control period (N, 3)"""
    common: Floats
    """nu or w: estimate of the common velocity (N, 3)"""
    anchor: Floats
    """c (N, 3)"""
    anchor_speed: Floats
    """g (N, 3)"""
    sent: Floats
    """own last sample (N, SAMPLE)"""
    sent_step: Ints
    """(N,), NEVER before the first"""
    limit: Floats
    """jittered T_max of the present silence (N,)"""
    clock: Floats
    """t_last of the float clock (N,)"""
    own: Floats
    """what the peers predict of this agent (N, 6), and its anchor (N, 9)"""
    residual: Floats
    """mean residual of the last control period (N, 3)"""
    neighbours: Floats
    """how many took part in it (N,)"""
    observed: Floats
    """observer of the elastic baseline (N, 6)"""
    predicted: Floats
    """rows (R, 12): p^, v^, slot's place, anchor"""
    held: Floats
    """samples (R, SAMPLE)"""
    held_step: Ints
    stopped: Floats
    """(R, 3): where a peer that fell silent may have stopped"""
    offset: Floats
    """D_i (N, 3)"""
    slot: Floats
    """place of the slot now (N, 3)"""
    start: Ints
    """row pointer of the neighbour list (N + 1,)"""
    column: Ints
    ring: Floats
    """(delay + 1, N, SAMPLE)"""
    ring_step: Ints
    ring_digest: Floats
    """(delay + 1, N, DIGEST, SAMPLE)"""
    ring_digest_step: Ints
    ring_digest_id: Ints
    outage: Flags
    """(R,) 1: the link is down"""
    keys: npt.NDArray[np.uint64]
    """(N, 8): each agent's own streams"""
    near: Floats
    """(most neighbours, ROW): what one agent knows of its neighbours"""
    near_row: Ints
    """(most neighbours,): which row of `predicted` each of these is"""
    planes: Floats
    """(most neighbours, 5): half-planes of the safety filter, with the velocity of each obstacle"""
    spare: Floats
    """(most neighbours, 3): room for its program"""
    scratch: Floats
    measures: Floats
    """see MEASURES"""
    events: Ints
    """(most, 2): step, agent"""
    counts: Ints
    """[number of events, bytes' samples sent, mode steps dynamic, mode steps fixed, filter active]"""
    record: Floats
    """(steps kept, N, 6)"""
    record_u: Floats


MEASURES = (
    "minimum_distance_m",
    "peak_command_m_s2",
    "bound_samples",
    "bound_violations",
    "bound_worst_ratio",
    "prediction_error_square_sum",
    "prediction_error_max_m",
)

_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_MIX1 = np.uint64(0xBF58476D1CE4E5B9)
_MIX2 = np.uint64(0x94D049BB133111EB)
_S30, _S27, _S31, _S11 = np.uint64(30), np.uint64(27), np.uint64(31), np.uint64(11)


@kernel
def uniform(key: np.uint64, counter: int) -> float:
    """Number `counter` of a stream, in [0, 1): splitmix64 of key and counter."""
    z = key + np.uint64(counter) * _GOLDEN
    z = (z ^ (z >> _S30)) * _MIX1
    z = (z ^ (z >> _S27)) * _MIX2
    z = z ^ (z >> _S31)
    return float(z >> _S11) * (1.0 / 9007199254740992.0)


@kernel
def normals(key: np.uint64, counter: int) -> tuple[float, float]:
    """A pair of independent standard normals (Box-Muller)."""
    r = math.sqrt(-2.0 * math.log(1.0 - uniform(key, 2 * counter)))
    a = 2.0 * math.pi * uniform(key, 2 * counter + 1)
    return r * math.cos(a), r * math.sin(a)


@kernel
def normal3(key: np.uint64, counter: int) -> tuple[float, float, float]:
    a, b = normals(key, 2 * counter)
    c, _ = normals(key, 2 * counter + 1)
    return a, b, c


@kernel
def hold_weights(kind: int, tau: float, damping: float) -> Weights:
    if kind == HOLD_DAMPED:
        return damped(tau, damping)
    if kind == HOLD_FIRST:
        return first(tau)
    return zero()


@kernel
def predict(
    out: Floats, sample: Floats, then: int, now: int, j: int, ref: Floats, slot: Floats, o: Options, ig: IntentGains
) -> None:
    """p^, v^ and anchor of agent j at step `now` from its sample of step `then`, into out[0:6], out[9:12] of a row."""
    tau = max((now - then) * o.dt, 0.0)
    m = j if ref.shape[1] > 1 else 0
    if o.intent == 1:
        r = response(tau, ig)
        for k in range(3):
            c, rate = anchor_axis(sample[k], sample[3 + k], sample[6 + k], tau, ig.c_g)
            out[k] = slot[k] + c + r.ee * sample[9 + k] + r.ed * sample[12 + k]
            out[3 + k] = ref[now, m, 3 + k] + rate + r.de * sample[9 + k] + r.dd * sample[12 + k]
            out[9 + k] = c
        return
    w = hold_weights(o.hold, tau, o.damping)
    for k in range(3):
        if o.leaderless == 1:
            nu = sample[6 + k]
            out[k], out[3 + k] = axis(sample[k], sample[3 + k], 0.0, nu, nu * tau, nu, w)
        else:
            out[k], out[3 + k] = axis(
                sample[k], sample[3 + k], ref[then, m, k], ref[then, m, 3 + k], ref[now, m, k], ref[now, m, 3 + k], w
            )


@kernel
def place_slots(k: int, s: State, ref: Floats) -> None:
    """Where every slot is at step k."""
    for i in range(s.x.shape[0]):
        m = i if ref.shape[1] > 1 else 0
        for c in range(3):
            s.slot[i, c] = ref[k, m, c] + s.offset[i, c]


@kernel
def measure(k: int, s: State, o: Options) -> None:
    """Own states as the sensors give them at step k."""
    for i in range(s.x.shape[0]):
        if i == o.fault_agent and o.fault_step <= k:
            continue
        n0, n1, n2 = 0.0, 0.0, 0.0
        if o.sigma_v > 0.0:
            n0, n1, n2 = normal3(s.keys[i, 2], k)
        s.measured[i, 3] = s.v[i, 0] + o.sigma_v * n0
        s.measured[i, 4] = s.v[i, 1] + o.sigma_v * n1
        s.measured[i, 5] = s.v[i, 2] + o.sigma_v * n2
        for c in range(3):
            s.measured[i, c] = s.x[i, c] + s.bias[i, c]


@kernel
def filter_own(k: int, s: State, o: Options) -> None:
    """The send filter: what is compared and sent."""
    dt = o.every * o.dt
    for i in range(s.x.shape[0]):
        for c in range(3):
            if k == 0 or o.send_filter == 0:
                s.filtered[i, c], s.filtered[i, 3 + c] = s.measured[i, c], s.measured[i, 3 + c]
            else:
                s.filtered[i, c], s.filtered[i, 3 + c] = alpha_beta(
                    s.filtered[i, c], s.filtered[i, 3 + c], s.measured[i, c], s.measured[i, 3 + c], s.u[i, c], dt
                )


@inlined
def compose(i: int, k: int, s: State, ref: Floats, o: Options) -> None:
    """The sample that agent i would send now, into s.sent."""
    m = i if ref.shape[1] > 1 else 0
    for c in range(3):
        p, v = s.filtered[i, c], s.filtered[i, 3 + c]
        if o.intent == 1:
            s.sent[i, c] = s.anchor[i, c]
            s.sent[i, 3 + c] = s.anchor_speed[i, c]
            s.sent[i, 6 + c] = s.common[i, c]
            s.sent[i, 9 + c] = p - s.slot[i, c] - s.anchor[i, c]
            s.sent[i, 12 + c] = v - ref[k, m, 3 + c] - s.common[i, c] - s.anchor_speed[i, c]
        else:
            s.sent[i, c] = p
            s.sent[i, 3 + c] = v
            s.sent[i, 6 + c] = s.common[i, c]
    s.sent_step[i] = k


@inlined
def fires(i: int, k: int, s: State, o: Options, et: ErrorTrigger, st: SwitchingTrigger, it: IntentTrigger) -> bool:
    """Whether agent i's trigger asks for a message at step k; heartbeat and t_min come on top."""
    t = k * o.dt
    ep = 0.0
    ev = 0.0
    for c in range(3):
        a = s.filtered[i, c] - s.own[i, c]
        b = s.filtered[i, 3 + c] - s.own[i, 3 + c]
        ep += a * a
        ev += b * b
    res = s.residual[i, 0] ** 2 + s.residual[i, 1] ** 2 + s.residual[i, 2] ** 2
    kind = o.trigger
    if kind == ERROR:
        return exceeds(ep, ev, res, et)
    if kind == INTENT:
        ec = 0.0
        for c in range(3):
            a = s.anchor[i, c] - s.own[i, 6 + c]
            ec += a * a
        return anchor_exceeds(ec, res, it) or exceeds(ep, ev, 0.0, et)
    if kind == SWITCHING:
        if o.mode_by_residual == 1:
            s.counts[2 if math.sqrt(res) > st.eta else 3] += 1
            return ep + st.gamma_s2 * ev >= switching_threshold(res, 0.0, t, st)
        s.counts[2 if math.sqrt(ep) + math.sqrt(ev) > st.eta else 3] += 1
        return switching_exceeds(ep, ev, t, st)
    if kind == PERIODIC:
        return period_ended(k * o.dt_ns, s.sent_step[i] * o.dt_ns, o.period_ns)
    if kind == FLOAT_CLOCK:
        if t - s.clock[i] >= o.period:
            s.clock[i] = t
            return True
        return False
    n = max(s.neighbours[i], 1.0)
    # the residual is the mean over neighbours, so that z_i is n times it
    if kind == CLASSIC:
        return ep + et.gamma_s2 * ev > classic_threshold(n, n * n * res, o.relative_sigma, o.relative_a)
    return ep + et.gamma_s2 * ev >= elastic_threshold(res, t, o.relative_sigma, o.elastic_amplitude, o.relative_a)


@kernel
def send(
    k: int, tick: int, s: State, ref: Floats, o: Options,
    et: ErrorTrigger, st: SwitchingTrigger, it: IntentTrigger, ig: IntentGains,
) -> None:  # fmt: skip
    """Decide for each agent whether it sends at step k, and put the message on its way."""
    slots = s.ring_step.shape[0]
    for i in range(s.x.shape[0]):
        at = tick % slots
        s.ring_step[at, i] = NEVER
        if i == o.fault_agent and k >= o.fault_step + o.fault_frozen:
            continue
        opening = s.sent_step[i] == NEVER
        if not opening:
            predict(s.own[i], s.sent[i], s.sent_step[i], k, i, ref, s.slot[i], o, ig)
            if o.intent == 1:
                for c in range(3):
                    s.own[i, 6 + c] = s.own[i, 9 + c]
            if o.hold == HOLD_OBSERVER:
                for c in range(6):
                    s.own[i, c] = s.sent[i, c]
        asked = opening or fires(i, k, s, o, et, st, it)
        silent = (k - s.sent_step[i]) * o.dt
        timed = o.trigger == PERIODIC or o.trigger == FLOAT_CLOCK
        if not (opening or (asked and (timed or silent >= o.t_min - 1e-9)) or silent >= s.limit[i] - 1e-9):
            continue
        compose(i, k, s, ref, o)
        counted = s.counts[0]
        if not opening or o.count_start == 1:
            if counted < s.events.shape[0]:
                s.events[counted, 0], s.events[counted, 1] = k, i
            s.counts[0] += 1
            s.counts[1] += 1
        s.limit[i] = o.t_max * (0.8 + 0.2 * uniform(s.keys[i, 3], k))
        predict(s.own[i], s.sent[i], k, k, i, ref, s.slot[i], o, ig)
        if o.intent == 1:
            for c in range(3):
                s.own[i, 6 + c] = s.own[i, 9 + c]
        if o.links == 1:
            s.ring_step[at, i] = k
            for c in range(SAMPLE):
                s.ring[at, i, c] = s.sent[i, c]
            _digest(i, at, k, s, o)


@inlined
def _digest(i: int, at: int, k: int, s: State, o: Options) -> None:
    """The newest samples that agent i holds of others, newest first."""
    bound = k + 1
    taken = 0
    last = -1
    while taken < o.digest:
        best, best_step = -1, -1
        for e in range(s.start[i], s.start[i + 1]):
            h = s.held_step[e]
            # order by (step descending, position ascending), strictly after the one taken last
            later = h < bound or (h == bound and e > last)
            if h != NEVER and later and h > best_step:
                best, best_step = e, h
        if best == -1:
            break
        s.ring_digest_id[at, i, taken] = s.column[best]
        s.ring_digest_step[at, i, taken] = best_step
        for c in range(SAMPLE):
            s.ring_digest[at, i, taken, c] = s.held[best, c]
        bound, last = best_step, best
        taken += 1
    s.counts[1] += taken
    for t in range(taken, s.ring_digest_id.shape[2]):
        s.ring_digest_id[at, i, t] = -1


@kernel
def _store(e: int, sample: Floats, step: int, s: State) -> None:
    if step > s.held_step[e]:
        s.held_step[e] = step
        for c in range(SAMPLE):
            s.held[e, c] = sample[c]


@kernel
def deliver(k: int, tick: int, s: State, o: Options) -> None:
    """Hand over what was sent `delay` control periods ago, less what is lost."""
    n = s.x.shape[0]
    slots = s.ring_step.shape[0]
    sent_tick = tick - o.delay
    at = sent_tick % slots
    dt = o.every * o.dt
    average = o.loss
    leave = dt / max(o.burst, dt)
    enter = leave * average / max(1.0 - average, 1e-9)
    for i in range(n):
        for e in range(s.start[i], s.start[i + 1]):
            j = s.column[e]
            if o.burst > 0.0:
                chance = uniform(s.keys[i, 5], k * n + j)
                if tick == 0:
                    s.outage[e] = 1 if chance < average else 0
                elif s.outage[e] == 1:
                    s.outage[e] = 0 if chance < leave else 1
                else:
                    s.outage[e] = 1 if chance < enter else 0
            if sent_tick < 0 or s.ring_step[at, j] == NEVER:
                continue
            d = (s.x[i, 0] - s.x[j, 0]) ** 2 + (s.x[i, 1] - s.x[j, 1]) ** 2 + (s.x[i, 2] - s.x[j, 2]) ** 2
            if d > o.range_m * o.range_m:
                continue
            lost = s.outage[e] == 1 if o.burst > 0.0 else uniform(s.keys[i, 4], k * n + j) < o.loss
            if lost:
                continue
            _store(e, s.ring[at, j], s.ring_step[at, j], s)
            for d_at in range(o.digest):
                about = s.ring_digest_id[at, j, d_at]
                if about < 0:
                    break
                if about != i:
                    # row i lists every other agent in ascending order
                    _store(s.start[i] + about - (1 if about > i else 0), s.ring_digest[at, j, d_at],
                           s.ring_digest_step[at, j, d_at], s)  # fmt: skip


@kernel
def predict_all(k: int, s: State, ref: Floats, o: Options, ig: IntentGains) -> None:
    """Every row's prediction for step k."""
    n = s.x.shape[0]
    if o.links == 0:
        for j in range(n):
            if o.hold == HOLD_OBSERVER:
                dt = o.every * o.dt
                for c in range(3):
                    if k == 0:
                        s.observed[j, c], s.observed[j, 3 + c] = s.sent[j, c], s.sent[j, 3 + c]
                    s.observed[j, c], s.observed[j, 3 + c] = observer_axis(
                        s.observed[j, c], s.observed[j, 3 + c], s.sent[j, c], s.sent[j, 3 + c], o.observer_gain, dt
                    )
                    s.predicted[j, c], s.predicted[j, 3 + c] = s.observed[j, c], s.observed[j, 3 + c]
            else:
                # what everyone predicts of j is what j's own trigger has just computed
                for c in range(6):
                    s.predicted[j, c] = s.own[j, c]
                if o.intent == 1:
                    for c in range(3):
                        s.predicted[j, 9 + c] = s.own[j, 6 + c]
            for c in range(3):
                s.predicted[j, 6 + c] = s.slot[j, c]
            if j == o.fault_agent and k >= o.fault_step:
                predict(s.predicted[j], s.sent[j], s.sent_step[j], k, j, ref, s.slot[j], o, ig)
                if k == o.fault_step:
                    for c in range(3):
                        s.stopped[j, c] = s.predicted[j, c]
        return
    for e in range(s.column.shape[0]):
        j = s.column[e]
        if s.held_step[e] == NEVER:
            continue
        predict(s.predicted[e], s.held[e], s.held_step[e], k, j, ref, s.slot[j], o, ig)
        for c in range(3):
            s.predicted[e, 6 + c] = s.slot[j, c]
        if j == o.fault_agent and k == o.fault_step:
            for c in range(3):
                s.stopped[e, c] = s.predicted[e, c]


@kernel
def _gates(i: int, s: State, o: Options) -> tuple[float, float]:
    """Median residual over the neighbours of i that take part."""
    count = 0
    for e in range(s.start[i], s.start[i + 1]):
        j = s.column[e]
        r = e if o.links == 1 else j
        if o.links == 1 and s.held_step[e] == NEVER:
            continue
        s.scratch[0, count] = s.measured[i, 0] - s.predicted[r, 0] - s.slot[i, 0] + s.predicted[r, 6]
        s.scratch[1, count] = s.measured[i, 1] - s.predicted[r, 1] - s.slot[i, 1] + s.predicted[r, 7]
        count += 1
    if count == 0:
        return 0.0, 0.0
    return float(np.median(s.scratch[0, :count])), float(np.median(s.scratch[1, :count]))


ROW = 22
"""floats of a `Neighbour`: p^ 3, v^ 3, d_ij 3, in formation, shares the avoidance, uncertainty, lost, last seen 3,
slot's velocity 3 and acceleration 3"""


@kernel
def neighbour(rows: Floats, k: int) -> Neighbour:
    """Row k as the core's functions take it."""
    last_seen = None
    if rows[k, 12] > 0.0:
        last_seen = Ned(rows[k, 13], rows[k, 14], rows[k, 15])
    return Neighbour(
        0, Ned(rows[k, 0], rows[k, 1], rows[k, 2]), Ned(rows[k, 3], rows[k, 4], rows[k, 5]),
        Ned(rows[k, 6], rows[k, 7], rows[k, 8]), 0.0, rows[k, 9] > 0.0, rows[k, 10] > 0.0, rows[k, 11], last_seen,
        Ned(rows[k, 16], rows[k, 17], rows[k, 18]), Ned(rows[k, 19], rows[k, 20], rows[k, 21]), (),
    )  # fmt: skip


@kernel
def sums_over(ego: VehicleState, slot_velocity: Ned, rows: Floats, count: int, alone: bool, g: Gains) -> Sums:
    """`law.sums_over` of the first `count` rows, rounded after each term."""
    sx, sy, sz, vx, vy, vz, px, py, pz, rx, ry, rz, n = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(count):
        q = share(ego, slot_velocity, neighbour(rows, k), alone, g)
        sx, sy, sz = sx + q.sep_x, sy + q.sep_y, sz + q.sep_z
        vx, vy, vz = vx + q.vel_x, vy + q.vel_y, vz + q.vel_z
        px, py, pz = px + q.pos_x, py + q.pos_y, pz + q.pos_z
        rx, ry, rz, n = rx + q.res_x, ry + q.res_y, rz + q.res_z, n + q.formed
    return Sums(sx, sy, sz, vx, vy, vz, px, py, pz, rx, ry, rz, n)


@kernel
def constrain(
    u_north: float, u_east: float, ego: VehicleState, shared: Ned, rows: Floats, count: int, most: float,
    planes: Floats, spare: Floats,
) -> safety.Avoidance:  # fmt: skip
    """What `safety.SafetyFilter` makes of a command for the sake of the first `count` rows; see `safety.half_plane`."""
    peers = 0
    for k in range(count):
        n = neighbour(rows, k)
        if out_of_reach(ego, shared, n, most):
            continue
        h = half_plane(ego, shared, n)
        planes[peers, 0], planes[peers, 1], planes[peers, 2] = h.g_north, h.g_east, h.b
        planes[peers, 3], planes[peers, 4] = h.v_north, h.v_east
        peers += 1
    return avoid(
        u_north, u_east, ego.velocity_ned_m_s.north, ego.velocity_ned_m_s.east, planes, peers, peers, most, spare
    )


@inlined
def look(i: int, k: int, own: Floats, common: Ned, s: State, ref: Floats, o: Options) -> int:
    """What agent i knows of its neighbours, into s.near; returns how many there are.

    `common` is the velocity that leaderless agents take for that of everybody's slot.
    """
    t = k * o.dt
    range2 = o.range_m * o.range_m
    gated = t >= o.gates_after
    mx, my = _gates(i, s, o) if gated else (0.0, 0.0)
    several = ref.shape[1] > 1
    near, predicted, column = s.near, s.predicted, s.column
    x, y, z = own[0], own[1], own[2]
    if o.range_on_truth == 1:
        x, y, z = s.x[i, 0], s.x[i, 1], s.x[i, 2]
    d0, d1, d2 = s.slot[i, 0], s.slot[i, 1], s.slot[i, 2]
    count = 0
    for e in range(s.start[i], s.start[i + 1]):
        j = column[e]
        r = e if o.links == 1 else j
        m = j if several else 0
        if o.links == 1 and s.held_step[e] == NEVER:
            continue
        # Every value is read before the first is written: the compiler cannot know that the arrays are apart.
        p0, p1, p2 = predicted[r, 0], predicted[r, 1], predicted[r, 2]
        ex, ey, ez = x - p0, y - p1, z - p2
        if o.range_on_truth == 1:
            ex, ey, ez = x - s.x[j, 0], y - s.x[j, 1], z - s.x[j, 2]
        if ex * ex + ey * ey + ez * ez > range2:
            continue
        v0, v1, v2 = predicted[r, 3], predicted[r, 4], predicted[r, 5]
        o0, o1, o2 = d0 - predicted[r, 6], d1 - predicted[r, 7], d2 - predicted[r, 8]
        w0, w1, w2 = ref[k, m, 3], ref[k, m, 4], ref[k, m, 5]
        a0, a1, a2 = ref[k, m, 6], ref[k, m, 7], ref[k, m, 8]
        lost = j == o.fault_agent and t >= o.fault_step * o.dt + o.presence_delay
        apart = lost
        if gated:
            q0, q1 = s.measured[i, 0], s.measured[i, 1]
            apart = lost or is_outlier(v0 - w0, v1 - w1, q0 - p0 - o0 - mx, q1 - p1 - o1 - my)
        if o.leaderless == 1:
            w0, w1, w2 = common.north, common.east, common.down
        near[count, 0], near[count, 1], near[count, 2] = p0, p1, p2
        near[count, 3], near[count, 4], near[count, 5] = v0, v1, v2
        near[count, 6], near[count, 7], near[count, 8] = o0, o1, o2
        near[count, 9], near[count, 10] = 0.0 if apart else 1.0, 0.0 if lost else 1.0
        near[count, 11], near[count, 12] = o.uncertainty, 1.0 if lost else 0.0
        if lost:
            near[count, 13], near[count, 14], near[count, 15] = s.stopped[r, 0], s.stopped[r, 1], s.stopped[r, 2]
        near[count, 16], near[count, 17], near[count, 18] = w0, w1, w2
        near[count, 19], near[count, 20], near[count, 21] = a0, a1, a2
        s.near_row[count] = e
        count += 1
    return count


@inlined
def reread(i: int, count: int, own: Floats, s: State, o: Options, g: Gains) -> tuple[float, float, float]:
    """What other readings of Eq. (2) add to the separation: distances between true positions, other forms of phi_s."""
    sx, sy, sz = 0.0, 0.0, 0.0
    for q in range(count):
        row = s.near[q]
        if row[12] > 0.0:
            continue
        dx, dy, dz = own[0] - row[0], own[1] - row[1], own[2] - row[2]
        if o.separation_on_truth == 1:
            j = s.column[s.near_row[q]]
            f = separation(dx, dy, dz, g)
            dx, dy, dz = s.x[i, 0] - s.x[j, 0], s.x[i, 1] - s.x[j, 1], s.x[i, 2] - s.x[j, 2]
            h = separation(dx, dy, dz, g)
            sx, sy, sz = sx + h.sep_x - f.sep_x, sy + h.sep_y - f.sep_y, sz + h.sep_z - f.sep_z
        if o.separation_kind != CUT:
            a = other_separation(o.separation_kind, dx, dy, dz, g)
            sx, sy, sz = sx + a[0], sy + a[1], sz + a[2]
    return sx, sy, sz


@inlined
def agree(i: int, count: int, dt: float, s: State, o: Options) -> None:
    """One step of the estimate of the common velocity (`core.law.consensus`)."""
    n, x, y, z = 0.0, 0.0, 0.0, 0.0
    for q in range(count):
        if s.near[q, 9] > 0.0:
            e = s.near_row[q]
            h = s.held[e] if o.links == 1 else s.sent[s.column[e]]
            d0, d1, d2 = saturated(s.common[i, 0] - h[6], s.common[i, 1] - h[7], s.common[i, 2] - h[8], 1.0)
            n, x, y, z = n + 1.0, x + d0, y + d1, z + d2
    r0, r1, r2 = common_velocity_rate(n, x, y, z)
    s.common[i, 0] += dt * r0
    s.common[i, 1] += dt * r1
    s.common[i, 2] += dt * r2


@inlined
def intended(
    i: int, k: int, count: int, dt: float, ego: VehicleState, v_d: Ned, sums: Sums, s: State, ref: Floats, o: Options,
    g: Gains, ig: IntentGains,
) -> tuple[float, float, float]:  # fmt: skip
    """The command of the published-intent law (`core.law.intent`), and one step of its anchor."""
    m = i if ref.shape[1] > 1 else 0
    n, ax, ay, az, qx, qy, qz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for q in range(count):
        if s.near[q, 9] > 0.0:
            e = s.near_row[q]
            row = s.predicted[e if o.links == 1 else s.column[e]]
            cx, cy, cz = s.anchor[i, 0] - row[9], s.anchor[i, 1] - row[10], s.anchor[i, 2] - row[11]
            d0, d1, d2 = saturated(cx, cy, cz, 1.0)
            n, ax, ay, az = n + 1.0, ax + d0, ay + d1, az + d2
            qx, qy, qz = qx + cx, qy + cy, qz + cz
    # residual of the anchors: what the trigger of this law looks at
    each = max(n, 1.0)
    s.residual[i, 0], s.residual[i, 1], s.residual[i, 2] = qx / each, qy / each, qz / each
    g0, g1, g2 = anchor_rate(n, ax, ay, az, ig)
    s.anchor_speed[i, 0], s.anchor_speed[i, 1], s.anchor_speed[i, 2] = g0, g1, g2
    p, v = ego.position_ned_m, ego.velocity_ned_m_s
    b0, b1, b2 = intent_rest(
        p.north - s.slot[i, 0] - s.anchor[i, 0],
        p.east - s.slot[i, 1] - s.anchor[i, 1],
        p.down - s.slot[i, 2] - s.anchor[i, 2],
        v.north - v_d.north - s.common[i, 0] - g0,
        v.east - v_d.east - s.common[i, 1] - g1,
        v.down - v_d.down - s.common[i, 2] - g2,
        ref[k, m, 6], ref[k, m, 7], ref[k, m, 8], ig,
    )  # fmt: skip
    for c in range(3):
        s.anchor[i, c] += dt * (s.common[i, c] + s.anchor_speed[i, c])
    return within_budget(sums.sep_x, sums.sep_y, sums.sep_z, b0, b1, b2, g.a_max)


@kernel
def command(k: int, s: State, ref: Floats, o: Options, g: Gains, ig: IntentGains) -> None:
    """Law and safety filter of every agent at step k, into s.u; and the estimates that go with them."""
    dt = o.every * o.dt
    for i in range(s.x.shape[0]):
        m = i if ref.shape[1] > 1 else 0
        own = s.own[i] if o.own_held == 1 else s.measured[i]
        ego = VehicleState(0, Ned(own[0], own[1], own[2]), Ned(own[3], own[4], own[5]))
        v_d = Ned(ref[k, m, 3], ref[k, m, 4], ref[k, m, 5])
        common = v_d
        if o.leaderless == 1:
            common = Ned(s.common[i, 0], s.common[i, 1], s.common[i, 2])
        reference = Reference(
            Ned(s.slot[i, 0], s.slot[i, 1], s.slot[i, 2]), common, Ned(ref[k, m, 6], ref[k, m, 7], ref[k, m, 8]), 0.0
        )
        count = look(i, k, own, common, s, ref, o)
        sums = sums_over(ego, common, s.near, count, False, g)
        if o.separation_on_truth == 1 or o.separation_kind != CUT:
            x, y, z = reread(i, count, own, s, o, g)
            sums = Sums(
                sums.sep_x + x, sums.sep_y + y, sums.sep_z + z, sums.vel_x, sums.vel_y, sums.vel_z,
                sums.pos_x, sums.pos_y, sums.pos_z, sums.res_x, sums.res_y, sums.res_z, sums.formed,
            )  # fmt: skip
        s.neighbours[i] = sums.formed
        if o.intent == 1:
            u0, u1, u2 = intended(i, k, count, dt, ego, v_d, sums, s, ref, o, g, ig)
        else:
            u0, u1, u2 = combine(sums, ego, reference, g)
            residual = mean_residual(sums)
            s.residual[i, 0], s.residual[i, 1], s.residual[i, 2] = residual.north, residual.east, residual.down
        if o.leaderless == 1:
            agree(i, count, dt, s, o)
        if o.barrier == 1:
            q = s.measured[i]
            true = VehicleState(0, Ned(q[0], q[1], q[2]), Ned(q[3], q[4], q[5]))
            kept = constrain(
                u0, u1, true, reference.acceleration_ned_m_s2, s.near, count, o.avoidance_max, s.planes, s.spare
            )
            u0, u1 = kept.north, kept.east
            s.counts[4] += 1 if kept.peer else 0
        s.u[i, 0], s.u[i, 1], s.u[i, 2] = u0, u1, u2


@kernel
def move(k: int, s: State, o: Options) -> None:
    """Eq. (1) over one step: p' = v, v' = a + d, with a behind the actuator's lag."""
    dt = o.dt
    follow = 1.0 - math.exp(-dt / o.lag) if o.lag > 0.0 else 1.0
    keep = math.exp(-dt / o.gust_time)
    drive = o.gust * math.sqrt(1.0 - keep * keep)
    keep_p = math.exp(-dt / o.sigma_p_time)
    drive_p = o.sigma_p * math.sqrt(1.0 - keep_p * keep_p)
    if k == o.push_step:
        s.v[o.push_agent, 0] += o.push_x
        s.v[o.push_agent, 1] += o.push_y
        s.v[o.push_agent, 2] += o.push_z
    for i in range(s.x.shape[0]):
        d0, d1, d2 = 0.0, 0.0, 0.0
        if o.gust > 0.0:
            n0, n1, n2 = normal3(s.keys[i, 0], k + 1)
            s.gust[i, 0] = keep * s.gust[i, 0] + drive * n0
            s.gust[i, 1] = keep * s.gust[i, 1] + drive * n1
            s.gust[i, 2] = keep * s.gust[i, 2] + drive * n2
            d0, d1, d2 = s.gust[i, 0], s.gust[i, 1], s.gust[i, 2]
        if o.sigma_p > 0.0:
            n0, n1, n2 = normal3(s.keys[i, 1], k + 1)
            s.bias[i, 0] = keep_p * s.bias[i, 0] + drive_p * n0
            s.bias[i, 1] = keep_p * s.bias[i, 1] + drive_p * n1
            s.bias[i, 2] = keep_p * s.bias[i, 2] + drive_p * n2
        if o.impulse > 0.0 and uniform(s.keys[i, 6], 8 * k) < o.impulse_probability:
            n0, n1, n2 = normal3(s.keys[i, 7], k)
            size = max(math.sqrt(n0 * n0 + n1 * n1 + n2 * n2), 1e-9)
            d0, d1, d2 = d0 + o.impulse * n0 / size, d1 + o.impulse * n1 / size, d2 + o.impulse * n2 / size
        if i == o.fault_agent and k >= o.fault_step + o.fault_frozen:
            # its autopilot brakes at 3 m/s^2 and stays
            speed = math.sqrt(s.v[i, 0] ** 2 + s.v[i, 1] ** 2 + s.v[i, 2] ** 2)
            brake = max(speed - 3.0 * dt, 0.0) / max(speed, 1e-9)
            for c in range(3):
                s.v[i, c] *= brake
                s.x[i, c] += dt * s.v[i, c]
            continue
        for c in range(3):
            d = d0 if c == 0 else d1 if c == 1 else d2
            s.a[i, c] += follow * (s.u[i, c] - s.a[i, c])
            acceleration = s.a[i, c] + d
            s.x[i, c] += dt * s.v[i, c] + 0.5 * dt * dt * acceleration
            s.v[i, c] += dt * acceleration


@kernel
def watch(s: State, o: Options, et: ErrorTrigger) -> None:
    """Measures that need every step: distances, commands, prediction errors against their bound."""
    n = s.x.shape[0]
    least = s.measures[0] * s.measures[0]
    for i in range(n):
        size = math.sqrt(s.u[i, 0] ** 2 + s.u[i, 1] ** 2 + s.u[i, 2] ** 2)
        s.measures[1] = max(s.measures[1], size)
        for j in range(i):
            d = (s.x[i, 0] - s.x[j, 0]) ** 2 + (s.x[i, 1] - s.x[j, 1]) ** 2 + (s.x[i, 2] - s.x[j, 2]) ** 2
            least = min(least, d)
    s.measures[0] = math.sqrt(least)
    rows = s.column.shape[0] if o.links == 1 else n
    for r in range(rows):
        j = s.column[r] if o.links == 1 else r
        if j == o.fault_agent or (o.links == 1 and s.held_step[r] == NEVER):
            continue
        d = 0.0
        for c in range(3):
            d += (s.x[j, c] - s.predicted[r, c]) ** 2
        kappa = 0.0 if o.intent == 1 else et.kappa
        res = s.residual[j, 0] ** 2 + s.residual[j, 1] ** 2 + s.residual[j, 2] ** 2
        epsilon = math.sqrt(et.epsilon_m * et.epsilon_m + kappa * kappa * res)
        bound = o.bound_slope * epsilon + o.bound_constant
        error = math.sqrt(d)
        s.measures[2] += 1.0
        s.measures[3] += 1.0 if error > bound else 0.0
        s.measures[4] = max(s.measures[4], error / max(bound, 1e-9))
        s.measures[5] += d
        s.measures[6] = max(s.measures[6], error)


@kernel
def advance(
    k0: int, k1: int, keep_every: int, s: State, ref: Floats, o: Options, g: Gains, ig: IntentGains,
    et: ErrorTrigger, st: SwitchingTrigger, it: IntentTrigger,
) -> None:  # fmt: skip
    """Steps k0 .. k1 - 1 of a run."""
    n = s.x.shape[0]
    for k in range(k0, k1):
        if k % keep_every == 0 and k // keep_every < s.record.shape[0]:
            for i in range(n):
                for c in range(3):
                    s.record[k // keep_every, i, c] = s.x[i, c]
                    s.record[k // keep_every, i, 3 + c] = s.v[i, c]
                    s.record_u[k // keep_every, i, c] = s.u[i, c]
        if k % o.every == 0:
            tick = k // o.every
            place_slots(k, s, ref)
            measure(k, s, o)
            filter_own(k, s, o)
            send(k, tick, s, ref, o, et, st, it, ig)
            if o.links == 1:
                deliver(k, tick, s, o)
            predict_all(k, s, ref, o, ig)
            command(k, s, ref, o, g, ig)
            if o.dense_measures == 1:
                watch(s, o, et)
        move(k, s, o)


@kernel
def cells(x: Floats, low: Floats, width: float, shape: Ints, cell: Ints, count: Ints, order: Ints) -> None:
    """Counting sort of agents into cells: `order` lists agents by cell, `count` becomes each cell's first place."""
    n = x.shape[0]
    count[:] = 0
    for i in range(n):
        a = min(int((x[i, 0] - low[0]) / width), shape[0] - 1)
        b = min(int((x[i, 1] - low[1]) / width), shape[1] - 1)
        c = min(int((x[i, 2] - low[2]) / width), shape[2] - 1)
        cell[i] = (a * shape[1] + b) * shape[2] + c
        count[cell[i] + 1] += 1
    for k in range(1, count.shape[0]):
        count[k] += count[k - 1]
    place = count.copy()
    for i in range(n):
        order[place[cell[i]]] = i
        place[cell[i]] += 1


@kernel
def listed(
    x: Floats, low: Floats, width: float, shape: Ints, count: Ints, order: Ints, reach: float, start: Ints, column: Ints
) -> int:
    """The list: row i holds all j != i within `reach`. Returns the entries needed, even if `column` is too short."""
    n = x.shape[0]
    total = 0
    reach2 = reach * reach
    for i in range(n):
        start[i] = total
        a = min(int((x[i, 0] - low[0]) / width), shape[0] - 1)
        b = min(int((x[i, 1] - low[1]) / width), shape[1] - 1)
        c = min(int((x[i, 2] - low[2]) / width), shape[2] - 1)
        for aa in range(max(a - 1, 0), min(a + 2, shape[0])):
            for bb in range(max(b - 1, 0), min(b + 2, shape[1])):
                # cells along the last axis lie next to each other: one run
                base = (aa * shape[1] + bb) * shape[2]
                for p in range(count[base + max(c - 1, 0)], count[base + min(c + 1, shape[2] - 1) + 1]):
                    j = order[p]
                    d = (x[i, 0] - x[j, 0]) ** 2 + (x[i, 1] - x[j, 1]) ** 2 + (x[i, 2] - x[j, 2]) ** 2
                    if d <= reach2 and j != i:
                        if total < column.shape[0]:
                            column[total] = j
                        total += 1
    start[n] = total
    return total


@kernel
def largest_shift(x: Floats, then: Floats) -> float:
    """The largest displacement since the list was built, the mean drift taken out."""
    n = x.shape[0]
    m0, m1, m2 = 0.0, 0.0, 0.0
    for i in range(n):
        m0 += x[i, 0] - then[i, 0]
        m1 += x[i, 1] - then[i, 1]
        m2 += x[i, 2] - then[i, 2]
    m0, m1, m2 = m0 / n, m1 / n, m2 / n
    largest = 0.0
    for i in range(n):
        d = (x[i, 0] - then[i, 0] - m0) ** 2 + (x[i, 1] - then[i, 1] - m1) ** 2 + (x[i, 2] - then[i, 2] - m2) ** 2
        largest = max(largest, d)
    return math.sqrt(largest)
