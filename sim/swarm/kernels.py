"""The swarm's step: measure, filter, exchange, command, move. Imported only once numba is wanted.

Law, safety filter, prediction, triggers and gates are those of `companion.core`, compiled as they are
(`sim.swarm.compiled`, `sim.swarm.rows`); the network is in `sim.swarm.exchange`, what each agent makes of what it knows
in `sim.swarm.command`. Arrays say their shape in `State`; N agents, R rows (a row is what one receiver holds of one
sender: R = N while nothing is lost or late, else one for each ordered pair).

What flies besides in a vehicle, and is left out here: the fence, the limits on jerk and speed, the altitude with its
own loop and limits (the law acts in all three dimensions here), the bias observer, what a peer does on the ground or
under its pilot, announcements and their repeats, the growth of a lost peer's uncertainty. Sums over neighbours are
rounded after each term, once in a vehicle: commands differ by less than 1e-9 of what is summed.
"""

import math

from companion.core.law.intent import IntentGains, IntentTrigger
from companion.core.law.starling import Gains
from companion.core.trigger.error import ErrorTrigger
from companion.core.trigger.switching import SwitchingTrigger
from sim.swarm.chance import normal3, uniform
from sim.swarm.command import command
from sim.swarm.compiled import alpha_beta, kernel
from sim.swarm.exchange import deliver, predict_all, send
from sim.swarm.state import ERROR_BIN_M, ERROR_BINS, NEVER, Floats, Options, State


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
        share = 1.0
        for row in range(s.disturbances.shape[0]):
            if s.disturbances[row, 0] == i and s.disturbances[row, 1] <= k < s.disturbances[row, 2]:
                share *= s.disturbances[row, 3]
                d0 += s.disturbances[row, 4]
                d1 += s.disturbances[row, 5]
                d2 += s.disturbances[row, 6]
        for c in range(3):
            d = d0 if c == 0 else d1 if c == 1 else d2
            s.a[i, c] += follow * (share * s.u[i, c] - s.a[i, c])
            acceleration = s.a[i, c] + d
            s.x[i, c] += dt * s.v[i, c] + 0.5 * dt * dt * acceleration
            s.v[i, c] += dt * acceleration


@kernel
def watch(s: State, o: Options) -> None:
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
        error = math.sqrt(d)
        s.error_bins[min(int(error / ERROR_BIN_M), ERROR_BINS - 1)] += 1
        s.measures[2] += 1.0
        s.measures[3] += 1.0 if error > o.bound_m else 0.0
        s.measures[4] = max(s.measures[4], error / o.bound_m)
        s.measures[5] += d
        s.measures[6] = max(s.measures[6], error)


@kernel
def exchange(
    k: int, keep_every: int, s: State, ref: Floats, o: Options, ig: IntentGains,
    et: ErrorTrigger, st: SwitchingTrigger, it: IntentTrigger,
) -> None:  # fmt: skip
    """Step k up to the laws: the state is kept, and in a control period measured, sent and predicted."""
    if k % keep_every == 0 and k // keep_every < s.record.shape[0]:
        for i in range(s.x.shape[0]):
            for c in range(3):
                s.record[k // keep_every, i, c] = s.x[i, c]
                s.record[k // keep_every, i, 3 + c] = s.v[i, c]
            if o.threat_begins < math.inf:
                for c in range(3):
                    s.record_common[k // keep_every, i, c] = s.common[i, c]
                s.record_common[k // keep_every, i, 3] = s.evasion[i, 0]
    if k % o.every == 0:
        tick = k // o.every
        place_slots(k, s, ref)
        measure(k, s, o)
        filter_own(k, s, o)
        send(k, tick, s, ref, o, et, st, it, ig)
        if o.links == 1:
            deliver(k, tick, s, o)
        predict_all(k, s, ref, o, ig)


@kernel
def fly(k: int, s: State, o: Options) -> None:
    """Step k after the laws."""
    if k % o.every == 0 and o.dense_measures == 1:
        watch(s, o)
    move(k, s, o)


@kernel
def advance(
    k0: int, k1: int, keep_every: int, s: State, ref: Floats, o: Options, g: Gains, ig: IntentGains,
    et: ErrorTrigger, st: SwitchingTrigger, it: IntentTrigger,
) -> None:  # fmt: skip
    """Steps k0 .. k1 - 1 of a run."""
    for k in range(k0, k1):
        exchange(k, keep_every, s, ref, o, ig, et, st, it)
        if k % o.every == 0:
            command(k, s, ref, o, g, ig)
        fly(k, s, o)
