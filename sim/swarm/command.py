"""What each agent of the swarm knows of its neighbours, and commands then, compiled: gates, law, agreement, evasion,
safety filter."""

import math

import numpy as np

from companion.core.frames import Ned
from companion.core.law.evasion import CALM, FLEES, Evasion, Threat
from companion.core.law.intent import IntentGains
from companion.core.law.starling import Gains, Sums
from companion.core.trajectory.fleet import Reference
from companion.core.values import CommonMotion, VehicleState
from sim.swarm.baselines import CUT
from sim.swarm.compiled import (
    anchor_rate,
    combine,
    common_velocity_rate,
    common_way,
    evade,
    inlined,
    intent_rest,
    is_outlier,
    kernel,
    mean_residual,
    other_separation,
    saturated,
    separation,
    within_budget,
)
from sim.swarm.rows import constrain, is_near, sums_over
from sim.swarm.state import NEVER, Floats, Options, State


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


@inlined
def look(i: int, k: int, own: Floats, common: Ned, s: State, ref: Floats, o: Options) -> int:
    """What agent i knows of its neighbours, into s.near; returns how many there are.

    `common` is the velocity that leaderless agents take for that of everybody's slot.
    """
    t = k * o.dt
    range2 = o.range_m * o.range_m
    gated = t >= o.gates_after
    mx, my = _gates(i, s, o) if gated else (0.0, 0.0)
    somebody_lost = t >= o.fault_step * o.dt + o.presence_delay
    several = ref.shape[1] > 1
    w0, w1, w2, a0, a1, a2 = ref[k, 0, 3], ref[k, 0, 4], ref[k, 0, 5], ref[k, 0, 6], ref[k, 0, 7], ref[k, 0, 8]
    near, near_row, predicted, column, truth, held_step = s.near, s.near_row, s.predicted, s.column, s.x, s.held_step
    stopped, q0, q1 = s.stopped, s.measured[i, 0], s.measured[i, 1]
    begin, end, uncertainty, links = s.start[i], s.start[i + 1], o.uncertainty, o.links == 1
    x, y, z = own[0], own[1], own[2]
    if o.range_on_truth == 1:
        x, y, z = truth[i, 0], truth[i, 1], truth[i, 2]
    d0, d1, d2 = s.slot[i, 0], s.slot[i, 1], s.slot[i, 2]
    # First who is within range, without a branch, which would be guessed wrong for one in four.
    count = 0
    if o.range_on_truth == 1:
        for e in range(begin, end):
            j = column[e]
            ex, ey, ez = x - truth[j, 0], y - truth[j, 1], z - truth[j, 2]
            near_row[count] = e
            count += 1 if ex * ex + ey * ey + ez * ez <= range2 and not (links and held_step[e] == NEVER) else 0
    elif links:
        for e in range(begin, end):
            ex, ey, ez = x - predicted[e, 0], y - predicted[e, 1], z - predicted[e, 2]
            near_row[count] = e
            count += 1 if ex * ex + ey * ey + ez * ez <= range2 and held_step[e] != NEVER else 0
    else:
        for e in range(begin, end):
            j = column[e]
            ex, ey, ez = x - predicted[j, 0], y - predicted[j, 1], z - predicted[j, 2]
            near_row[count] = e
            count += 1 if ex * ex + ey * ey + ez * ez <= range2 else 0
    for q in range(count):
        r = near_row[q] if links else column[near_row[q]]
        p0, p1, p2 = predicted[r, 0], predicted[r, 1], predicted[r, 2]
        v0, v1, v2 = predicted[r, 3], predicted[r, 4], predicted[r, 5]
        o0, o1, o2 = d0 - predicted[r, 6], d1 - predicted[r, 7], d2 - predicted[r, 8]
        near[q, 0], near[q, 1], near[q, 2] = p0, p1, p2
        near[q, 3], near[q, 4], near[q, 5] = v0, v1, v2
        near[q, 6], near[q, 7], near[q, 8] = o0, o1, o2
        near[q, 9], near[q, 10], near[q, 11], near[q, 12] = 1.0, 1.0, uncertainty, 0.0
        near[q, 16], near[q, 17], near[q, 18] = w0, w1, w2
        near[q, 19], near[q, 20], near[q, 21] = a0, a1, a2
    if k < s.joined[i]:
        return 0
    if o.near == 1:
        for q in range(count):
            e = near_row[q]
            if s.held_due[e] == 1:
                near[q, 11] = s.missing[min(k - held_step[e], s.missing.shape[0] - 1)]
    if s.linked.shape[0] > 0:
        for q in range(count):
            near[q, 9] = float(s.linked[near_row[q]])
    if not (several or gated or somebody_lost or o.leaderless == 1):
        return count
    for q in range(count):
        e = near_row[q]
        j = column[e]
        if several:
            near[q, 16], near[q, 17], near[q, 18] = ref[k, j, 3], ref[k, j, 4], ref[k, j, 5]
            near[q, 19], near[q, 20], near[q, 21] = ref[k, j, 6], ref[k, j, 7], ref[k, j, 8]
        if gated and is_outlier(
            near[q, 3] - near[q, 16], near[q, 4] - near[q, 17],
            q0 - near[q, 0] - near[q, 6] - mx, q1 - near[q, 1] - near[q, 7] - my,
        ):  # fmt: skip
            near[q, 9] = 0.0
        if o.leaderless == 1:
            near[q, 16], near[q, 17], near[q, 18] = common.north, common.east, common.down
        if somebody_lost and j == o.fault_agent:
            r = e if links else j
            near[q, 9], near[q, 10], near[q, 12] = 0.0, 0.0, 1.0
            near[q, 13], near[q, 14], near[q, 15] = stopped[r, 0], stopped[r, 1], stopped[r, 2]
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
    c0, c1, c2 = s.common[i, 0], s.common[i, 1], s.common[i, 2]
    if o.intent == 0:
        # The own one as the others predict it, as `vehicle.agreement` has it.
        level = common_way(CommonMotion(c0, c1, s.common_rate[i, 0], s.common_rate[i, 1]), dt)
        c0, c1 = level.north_m_s, level.east_m_s
    for q in range(count):
        if s.near[q, 9] > 0.0:
            e = s.near_row[q]
            j = s.column[e]
            if o.intent == 0:
                r = e if o.links == 1 else j
                h0, h1, h2 = s.predicted[r, 9], s.predicted[r, 10], s.predicted[r, 11]
            elif o.links == 1:
                h0, h1, h2 = s.held[e, 6], s.held[e, 7], s.held[e, 8]
            else:
                h0, h1, h2 = s.sent[j, 6], s.sent[j, 7], s.sent[j, 8]
            d0, d1, d2 = saturated(c0 - h0, c1 - h1, c2 - h2, 1.0)
            n, x, y, z = n + 1.0, x + d0, y + d1, z + d2
    r0, r1, r2 = common_velocity_rate(n, x, y, z)
    s.common_rate[i, 0], s.common_rate[i, 1], s.common_rate[i, 2] = r0, r1, r2
    s.common[i, 0] += dt * r0
    s.common[i, 1] += dt * r1
    s.common[i, 2] += dt * r2


@inlined
def shy(i: int, k: int, dt: float, ego: VehicleState, s: State, o: Options) -> int:
    """One step of what agent i does about the threat (`core.law.evasion`), into its nu unless it is calm."""
    row, t, p = s.evasion[i], s.threat, ego.position_ned_m
    e = evade(
        Evasion(int(row[0]), row[1], row[2], row[3], row[4], row[5], row[6], row[7]),
        Threat(t[0], t[1], t[2], t[3], t[4], t[5]), k * o.dt - o.threat_begins, p.north, p.east, s.common[i, 0],
        s.common[i, 1], dt,
    )  # fmt: skip
    row[0], row[1], row[2], row[3], row[4] = float(e.doing), e.north_m_s, e.east_m_s, e.north_m_s2, e.east_m_s2
    row[5], row[6], row[7] = e.calm_north_m_s, e.calm_east_m_s, e.left_s
    if e.doing != CALM:
        s.common[i, 0], s.common[i, 1] = e.north_m_s, e.east_m_s
        s.common_rate[i, 0], s.common_rate[i, 1], s.common_rate[i, 2] = e.north_m_s2, e.east_m_s2, 0.0
    return e.doing


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


@inlined
def keep_apart(
    i: int, count: int, u0: float, u1: float, u2: float, k: int, slot_velocity: Ned, shared: Ned, s: State, o: Options
) -> None:  # fmt: skip
    """The command of agent i, after the safety filter if it is on, into s.u, and whom it finds near; see `look`."""
    if o.barrier == 1:
        q = s.measured[i]
        true = VehicleState(0, Ned(q[0], q[1], q[2]), Ned(q[3], q[4], q[5]))
        kept = constrain(u0, u1, true, shared, s.near, count, o.avoidance_max, s.planes, s.spare)
        u0, u1 = kept.north, kept.east
        if o.near == 1:
            for row in range(count):
                if is_near(true, slot_velocity, shared, s.near, row, o.avoidance_max, o.near_closest, o.near_radius):
                    s.near_until[s.near_row[row]] = k + o.near_hold
    s.u[i, 0], s.u[i, 1], s.u[i, 2] = u0, u1, u2


@kernel
def command(k: int, s: State, ref: Floats, o: Options, g: Gains, ig: IntentGains) -> None:
    """Law and safety filter of every agent at step k, into s.u; and the estimates that go with them."""
    dt = o.every * o.dt
    for i in range(s.x.shape[0]):
        m = i if ref.shape[1] > 1 else 0
        own = s.own[i] if o.own_held == 1 else s.measured[i]
        ego = VehicleState(0, Ned(own[0], own[1], own[2]), Ned(own[3], own[4], own[5]))
        v_d = Ned(ref[k, m, 3], ref[k, m, 4], ref[k, m, 5])
        shared = Ned(ref[k, m, 6], ref[k, m, 7], ref[k, m, 8])
        common, asked = v_d, shared
        informed = s.informed[i] == 1
        if informed:
            if s.evasion[i, 0] == CALM:
                for c in range(3):
                    s.common[i, c] = s.wish[k, c]
            s.evasion[i, 5], s.evasion[i, 6] = s.wish[k, 0], s.wish[k, 1]
            asked = Ned(s.wish[k, 3], s.wish[k, 4], s.wish[k, 5])
        doing = CALM
        if o.leaderless == 1:
            if o.threat_begins < math.inf:
                doing = shy(i, k, dt, ego, s, o)
            common = Ned(s.common[i, 0], s.common[i, 1], s.common[i, 2])
            if doing != CALM or (o.intent == 0 and not informed):
                asked = Ned(s.common_rate[i, 0], s.common_rate[i, 1], s.common_rate[i, 2])
        place = Ned(s.slot[i, 0], s.slot[i, 1], s.slot[i, 2])
        if k < s.joined[i] or doing == FLEES:
            # it flies along with the plan where it is, or has no place
            place = ego.position_ned_m
        reference = Reference(place, common, asked, 0.0, True)
        count = look(i, k, own, common, s, ref, o)
        sums = sums_over(ego, common, s.near, count, doing == FLEES, g)
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
        if o.leaderless == 1 and not informed and doing == CALM:
            agree(i, count, dt, s, o)
        keep_apart(i, count, u0, u1, u2, k, common, shared, s, o)
