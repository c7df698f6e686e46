"""Published intent: send what one intends instead of the noisy state, and track the intention locally.

Each vehicle keeps an anchor c_i, its estimate of the formation's common offset from the plan, started at the measured
p_i - p_ref - D_i and driven by messages alone:

    anchor   c' = w_i + g_i,  g_i = clip(-c_g mean_j sat_1(c_i - c^_j), c_max)
    control  u_rest = -k_d sat_1(v_i - v_d - w_i - g_i) - k_p sat_1(p_i - p_ref - D_i - c_i) + a_d
    predict  c^ = c_k + w_k tau + (1/c_g)(1 - e^(-c_g tau)) g_k
             e^(tau) = response of s^2 + k_d s + k_p to (e_k, e'_k);      p^ = p_ref + D + c^ + e^
    message  t, c, g, w, e = own state - intent, e'
    no plan  w' = -2 mean sat_1(w_i - w^_j), w(0) = own measured velocity; with a plan w = 0
    send     |c - c^| >= max(epsilon_c, kappa |mean_j(c_i - c^_j)|), or |p - p^|^2 + gamma |v - v^|^2 >= epsilon_p^2

Separation, the acceleration budget and the safety filter are those of `law` and `safety`. Plain floats, one function
per equation, as in `law`; the swarm compiles these. A vehicle flies them by `IntentLaw` and `IntentHold`:

* It tells the place that it intends, q = p_ref + D + c, and g; e and e' follow from the sample's p and v. So it is of
  no matter whether a plan gives p_ref. Where no motion is shared, q goes on with v_d, which has w in it
  (`vehicle.agreement`; w(0) is the velocity of the shared motion before).
* It acts on the level; altitude is flown by position.
* With a plan c comes back to 0 at TO_PLAN_PER_S, which g has in it: among those who tell the truth it stays near where
  it began, and whoever does not would draw it on and on.
* c starts within START_M of the slot: whoever is farther away flies there. Whoever was apart takes the mean of what it
  hears, and drags nobody.
* The hold predicts no more of the response than the acceleration limit allows (`IntentHold`).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import exp, hypot, inf, sqrt
from typing import NamedTuple

from companion.core.frames import Ned
from companion.core.law.base import Wanted
from companion.core.law.consensus import STEP_MAX_S, saturated
from companion.core.law.starling import Gains, Sums, separation, total, within_budget
from companion.core.prediction import Held, HoldBounds, Pull, axis, damped, returning
from companion.core.trajectory.fleet import Reference
from companion.core.values import Neighbour, PeerSample, VehicleState

FIELDS = ("intended_north_m", "intended_east_m", "anchor_north_m_s", "anchor_east_m_s")
"""what a vehicle tells: q, on the level of the fleet frame, and g"""
START_M = 0.3
"""an anchor starts no farther from the plan's place"""
TO_PLAN_PER_S = 0.1
"""how fast an anchor comes back to a plan's place: nobody's words draw the fleet off it for ever"""
FAR_M = 5.0
"""nobody intends a place that is farther from where it is: such a word is not heeded"""


class IntentGains(NamedTuple):
    """Gains of the published-intent law, per vehicle the same."""

    k_p: float
    """tracking of the own intended place (1/s^2)"""
    k_d: float
    """tracking of the own intended velocity (1/s)"""
    c_g: float
    """how fast anchors approach each other (1/s)"""
    c_max: float
    """largest speed of an anchor against the plan (m/s)"""
    saturation_position: float
    """norm at which a position error saturates (m)"""
    saturation_velocity: float
    """norm at which a velocity error saturates (m/s)"""


class IntentTrigger(NamedTuple):
    """Thresholds of the published-intent law."""

    epsilon_c_m: float
    """anchor"""
    kappa: float
    """part of the mean anchor residual that raises the anchor's threshold"""


def anchor_rate(n: float, sx: float, sy: float, sz: float, g: IntentGains) -> tuple[float, float, float]:
    """g_i (m/s) from the sum of sat_1(c_i - c^_j) over everyone heard."""
    rate = -g.c_g / max(n, 1.0)
    return saturated(rate * sx, rate * sy, rate * sz, g.c_max)


def rest(
    ex: float, ey: float, ez: float, wx: float, wy: float, wz: float, ax: float, ay: float, az: float, g: IntentGains
) -> tuple[float, float, float]:
    """u_rest (m/s^2) from e = p - p_ref - D - c (m), its rate v - v_d - w - g (m/s) and a_d (m/s^2)."""
    px, py, pz = saturated(ex, ey, ez, g.saturation_position)
    qx, qy, qz = saturated(wx, wy, wz, g.saturation_velocity)
    return ax - g.k_d * qx - g.k_p * px, ay - g.k_d * qy - g.k_p * py, az - g.k_d * qz - g.k_p * pz


def anchor_axis(c: float, g: float, w: float, tau_s: float, c_g: float) -> tuple[float, float]:
    """c^ (m) and its rate (m/s) of one axis, tau_s after the message."""
    left = exp(-c_g * tau_s)
    return c + w * tau_s + (1.0 - left) / c_g * g, w + left * g


def anchor_exceeds(error_2: float, mean_residual_2: float, t: IntentTrigger) -> bool:
    """Whether the anchor's squared error (m^2) reaches its threshold."""
    return error_2 >= max(t.epsilon_c_m * t.epsilon_c_m, t.kappa * t.kappa * mean_residual_2)


@dataclass(frozen=True, slots=True)
class IntentHold:
    """`core.prediction.Hold` of this law.

    The intended place goes on as its anchor does. The state about it, (e, e'), goes back as the response says as far as
    the law's budget allows it to, and the rest as in the damped hold (`prediction.returning`).

    By k_p e^2 + e'^2, which never grows, the response's four weights are within 1, 1/sqrt(k_p), sqrt(k_p) and 1. The
    vertical is held damped.
    """

    gains: IntentGains
    a_max_m_s2: float
    damping_s: float

    def at(self, sample: PeerSample, then: tuple[Ned, Ned], now: Reference, tau_s: float) -> Held:
        """See `Hold`."""
        g, w = self.gains, damped(tau_s, self.damping_s)
        p, v = sample.position_ned_m, sample.velocity_ned_m_s
        (p_then, v_then), p_now, v_now = then, now.position_ned_m, now.velocity_ned_m_s
        q_north, q_east, g_north, g_east = sample.told
        g_north, g_east, _ = saturated(g_north, g_east, 0.0, g.c_max)
        north, rate_north = anchor_axis(q_north, g_north, 0.0, tau_s, g.c_g)
        east, rate_east = anchor_axis(q_east, g_east, 0.0, tau_s, g.c_g)
        north, east = north + p_now.north - p_then.north, east + p_now.east - p_then.east
        e = p.north - q_north, p.east - q_east
        rate = v.north - v_then.north - g_north, v.east - v_then.east - g_east
        ee, ed, de, dd = returning(tau_s, hypot(*e), hypot(*rate), Pull(g.k_d, g.k_p, inf, self.a_max_m_s2), w)
        down, v_down = axis(p.down, v.down, p_then.down, v_then.down, p_now.down, v_now.down, w)
        return Held(
            Ned(north + ee * e[0] + ed * rate[0], east + ee * e[1] + ed * rate[1], down),
            Ned(
                v_now.north + rate_north + de * e[0] + dd * rate[0],
                v_now.east + rate_east + de * e[1] + dd * rate[1],
                v_down,
            ),
            (north, east, rate_north, rate_east),
        )

    def told_error_m(self, foreseen: tuple[float, ...], tells: tuple[float, ...]) -> float:
        """How far the intended place is from what the peers take it to be."""
        return hypot(foreseen[0] - tells[0], foreseen[1] - tells[1])

    def bounds(self, speed_max_m_s: float) -> HoldBounds:
        """The response within the law's budget, the damped rest, and the anchor."""
        g = self.gains
        braking = self.a_max_m_s2 + speed_max_m_s / self.damping_s + g.c_g * g.c_max
        return HoldBounds(braking, 0.0, self.a_max_m_s2 / sqrt(g.k_p) + g.c_max)


class IntentLaw:
    """`core.law.base.Law`: one vehicle's intended place, and how it is tracked."""

    def __init__(self, gains: IntentGains, apart: Gains) -> None:
        """`apart` are the gains of separation and the acceleration limit, those of the starling law."""
        self._gains = gains
        self._apart = apart
        self._place: tuple[float, float] | None = None
        """q; None before the first command"""
        self._rate = (0.0, 0.0)
        """g"""
        self._before: Reference | None = None
        """reference of the command before; None: the anchor starts anew"""
        self._time_ns = 0
        self._alone = False

    def command(
        self, ego: VehicleState, reference: Reference, neighbours: Sequence[Neighbour], *, alone: bool
    ) -> Wanted:
        """See `Law`; the residual is the mean of c_i - c^_j."""
        g = self._gains
        north, east = self._intended(ego, reference, alone)
        heard = [] if alone else [(n.told, n.offset_ned_m) for n in neighbours if n.in_formation and _plausible(n)]
        off = [(north - told[0] - d.north, east - told[1] - d.east) for told, d in heard]
        each = max(len(off), 1)
        mean = sum(x for x, _ in off) / each, sum(y for _, y in off) / each
        if self._alone and not alone:
            north, east = north - mean[0], east - mean[1]
            off, mean = [(x - mean[0], y - mean[1]) for x, y in off], (0.0, 0.0)
        errors = [saturated(x, y, 0.0, g.saturation_position) for x, y in off]
        g_north, g_east, _ = anchor_rate(
            float(len(errors)), sum(e[0] for e in errors), sum(e[1] for e in errors), 0.0, g
        )
        if reference.shared:
            r = reference.position_ned_m
            g_north, g_east, _ = saturated(
                g_north - TO_PLAN_PER_S * (north - r.north), g_east - TO_PLAN_PER_S * (east - r.east), 0.0, g.c_max
            )
        self._place, self._rate, self._alone = (north, east), (g_north, g_east), alone
        self._before, self._time_ns = reference, ego.time_ns
        p, v, v_d, a_d = ego.position_ned_m, ego.velocity_ned_m_s, *reference[1:3]
        b_north, b_east, _ = rest(
            p.north - north, p.east - east, 0.0, v.north - v_d.north - g_north, v.east - v_d.east - g_east, 0.0,
            a_d.north, a_d.east, 0.0, g,
        )  # fmt: skip
        s = total([_apart(p, n.position_ned_m, self._apart) for n in neighbours if n.last_seen_ned_m is None])
        u = within_budget(s.sep_x, s.sep_y, 0.0, b_north, b_east, 0.0, self._apart.a_max)
        return Wanted(Ned(*u), Ned(*mean, 0.0))

    def _intended(self, ego: VehicleState, reference: Reference, alone: bool) -> tuple[float, float]:
        """q now, from what it was and what g and the reference have made of it since."""
        r, before, place = reference.position_ned_m, self._before, self._place
        if alone:
            return r.north, r.east
        if before is None or place is None:
            p = ego.position_ned_m
            north, east, _ = saturated(p.north - r.north, p.east - r.east, 0.0, START_M)
            return r.north + north, r.east + east
        dt_s = min(max((ego.time_ns - self._time_ns) * 1e-9, 0.0), STEP_MAX_S)
        if reference.shared and before.shared:
            shift = r.north - before.position_ned_m.north, r.east - before.position_ned_m.east
        else:
            v = reference.velocity_ned_m_s
            shift = dt_s * v.north, dt_s * v.east
        return place[0] + shift[0] + dt_s * self._rate[0], place[1] + shift[1] + dt_s * self._rate[1]

    def reset(self) -> None:
        """The anchor starts anew at the next command; until then what was told stands."""
        self._before, self._alone = None, False

    @property
    def fields(self) -> tuple[str, ...]:
        """See FIELDS."""
        return FIELDS

    def tell(self) -> tuple[float, ...]:
        """The intended place, and its rate against the plan."""
        return (*(self._place or (0.0, 0.0)), *self._rate)


def _plausible(n: Neighbour) -> bool:
    return bool(n.told) and hypot(n.told[0] - n.position_ned_m.north, n.told[1] - n.position_ned_m.east) <= FAR_M


def _apart(p: Ned, q: Ned, g: Gains) -> Sums:
    return separation(p.north - q.north, p.east - q.east, p.down - q.down, g)
