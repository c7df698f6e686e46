"""The exchange between the agents, compiled: predictions, triggers, messages, and a network that loses and delays."""

# ruff: noqa: PLR1714 - chained comparisons compile to simpler code than membership tests
import math

from companion.core.law.base import FIELDS_MAX
from companion.core.law.intent import IntentGains, IntentTrigger
from companion.core.prediction import Weights
from companion.core.trigger.error import ErrorTrigger
from companion.core.trigger.switching import SwitchingTrigger
from companion.core.values import CommonMotion
from sim.swarm.chance import uniform
from sim.swarm.compiled import (
    anchor_axis,
    anchor_exceeds,
    axis,
    classic_threshold,
    common_way,
    damped,
    elastic_threshold,
    exceeds,
    first,
    inlined,
    kernel,
    observer_axis,
    period_ended,
    response,
    returning,
    switching_exceeds,
    switching_threshold,
    zero,
)
from sim.swarm.state import (
    CLASSIC,
    ERROR,
    FIRST,
    FLOAT_CLOCK,
    HEARTBEAT,
    HOLD_DAMPED,
    HOLD_FIRST,
    HOLD_OBSERVER,
    HOLD_RETURNING,
    INTENT,
    NEAR,
    NEVER,
    PERIODIC,
    SAMPLE,
    SWITCHING,
    TOLD,
    TRIGGERED,
    Floats,
    Options,
    State,
)


@kernel
def hold_weights(kind: int, tau: float, damping: float) -> Weights:
    if kind == HOLD_FIRST:
        return first(tau)
    return damped(tau, damping) if kind in (HOLD_DAMPED, HOLD_RETURNING) else zero()


@kernel
def predict(
    out: Floats, sample: Floats, then: int, now: int, j: int, ref: Floats, slot: Floats, o: Options, ig: IntentGains
) -> None:
    """p^, v^ and anchor, or nu, of agent j at step `now` from its sample of step `then`, into out[0:6], out[9:12]."""
    tau = max((now - then) * o.dt, 0.0)
    m = j if ref.shape[1] > 1 else 0
    if o.intent == 1:
        r = response(tau, ig.k_d, ig.k_p)
        for k in range(3):
            c, rate = anchor_axis(sample[k], sample[3 + k], sample[6 + k], tau, ig.c_g)
            out[k] = slot[k] + c + r.ee * sample[9 + k] + r.ed * sample[12 + k]
            out[3 + k] = ref[now, m, 3 + k] + rate + r.de * sample[9 + k] + r.dd * sample[12 + k]
            out[9 + k] = c
        return
    w = hold_weights(o.hold, tau, o.damping)
    if o.leaderless == 1:
        level = common_way(CommonMotion(sample[6], sample[7], sample[9], sample[10]), tau)
        upright = common_way(CommonMotion(sample[8], 0.0, sample[11], 0.0), tau)
        out[9], out[10], out[11] = level.north_m_s, level.east_m_s, upright.north_m_s
        out[0], out[3] = axis(sample[0], sample[3], 0.0, sample[6], level.north_m, out[9], w)
        out[1], out[4] = axis(sample[1], sample[4], 0.0, sample[7], level.east_m, out[10], w)
        out[2], out[5] = axis(sample[2], sample[5], 0.0, sample[8], upright.north_m, out[11], w)
        return
    if o.hold == HOLD_RETURNING:
        off2, rate2 = 0.0, 0.0
        for k in range(3):
            off2 += (sample[k] - slot[k] + ref[now, m, k] - ref[then, m, k]) ** 2
            rate2 += (sample[3 + k] - ref[then, m, 3 + k]) ** 2
        r = returning(tau, math.sqrt(off2), math.sqrt(rate2), o.pull, w)
        for k in range(3):
            off = sample[k] - slot[k] + ref[now, m, k] - ref[then, m, k]
            rate = sample[3 + k] - ref[then, m, 3 + k]
            out[k] = slot[k] + r.ee * off + r.ed * rate
            out[3 + k] = ref[now, m, 3 + k] + r.de * off + r.dd * rate
        return
    for k in range(3):
        out[k], out[3 + k] = axis(
            sample[k], sample[3 + k], ref[then, m, k], ref[then, m, 3 + k], ref[now, m, k], ref[now, m, 3 + k], w
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
            s.sent[i, 9 + c] = s.common_rate[i, c]
    for c in range(FIELDS_MAX):
        s.sent[i, TOLD + c] = s.told[i, c]
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
        if o.leaderless == 1 and o.intent == 0:
            nu = 0.0
            for c in range(3):
                a = s.common[i, c] - s.own[i, 9 + c]
                nu += a * a
            if nu >= et.epsilon_nu_m_s * et.epsilon_nu_m_s:
                return True
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
        shift = s.phase_ns[i, 0]
        return period_ended(k * o.dt_ns + shift, s.sent_step[i] * o.dt_ns + shift, o.period_ns)
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


@inlined
def finds_near(i: int, k: int, s: State) -> bool:
    """Whether agent i speaks in near mode: some peer is near, or named it."""
    for e in range(s.start[i], s.start[i + 1]):
        if s.near_until[e] > k:
            return True
    return bool(s.named_until[i] > k)


@inlined
def say_near(i: int, k: int, at: int, near: bool, s: State) -> None:
    """What a message says of near mode: that the next one is due soon, and who is near."""
    s.promised[i] = 1 if near else 0
    s.ring_due[at, i] = s.promised[i]
    for e in range(s.start[i], s.start[i + 1]):
        s.ring_near[at, i, s.column[e]] = 1 if near and s.near_until[e] > k else 0


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
        if (i == o.fault_agent and k >= o.fault_step + o.fault_frozen) or k < s.joined[i]:
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
        near = o.near == 1 and finds_near(i, k, s)
        cause = NEVER
        if opening:
            cause = FIRST
        elif silent >= s.limit[i] - 1e-9:
            cause = HEARTBEAT
        elif asked and (timed or silent >= o.t_min - 1e-9):
            cause = TRIGGERED
        elif near or s.promised[i] == 1:
            shift = s.phase_ns[i, 1]
            if period_ended(k * o.dt_ns + shift, s.sent_step[i] * o.dt_ns + shift, o.near_period_ns):
                cause = NEAR
        if cause == NEVER:
            continue
        compose(i, k, s, ref, o)
        counted = s.counts[0]
        if not opening or o.count_start == 1:
            if counted < s.events.shape[0]:
                s.events[counted, 0], s.events[counted, 1], s.events[counted, 2] = k, i, cause
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
            if o.near == 1:
                say_near(i, k, at, near, s)


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


@inlined
def _cut(i: int, j: int, k: int, s: State) -> bool:
    """Whether nothing goes from j to i at step k: the network is in two parts, or i does not take part yet."""
    for p in range(s.partitions.shape[0]):
        within = s.partitions[p, 0] <= k < s.partitions[p, 1]
        if within and (i < s.partitions[p, 2]) != (j < s.partitions[p, 2]):
            return True
    return bool(k < s.joined[i])


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
            if lost or _cut(i, j, k, s):
                continue
            s.counts[4] += 1
            if o.near == 1 and s.ring_step[at, j] > s.held_step[e]:
                s.held_due[e] = s.ring_due[at, j]
                if s.ring_near[at, j, i] == 1:
                    s.named_until[i] = k + o.near_hold
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
                for c in range(3):
                    if o.intent == 1:
                        s.predicted[j, 9 + c] = s.own[j, 6 + c]
                    elif o.leaderless == 1:
                        s.predicted[j, 9 + c] = s.own[j, 9 + c]
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
