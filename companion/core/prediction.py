"""Hold: what a sample says about now. The sender and every receiver call this one function, so they agree.

A law may have a hold of its own (`core.law.intent`), which its table makes (`config.law_tables`). The others have

damped     p^ = p_k + [p_ref(t) - p_ref(t_k)] + T_d (1 - e^(-tau/T_d)) (v_k - v_d(t_k))
           v^ = v_d(t) + e^(-tau/T_d) (v_k - v_d(t_k))                          tau = t - t_k
returning  p^ - p_ref, v^ - v_d = free response of e'' + k_v e' + k_p e = 0
zero       p^ = p_k, v^ = v_k                                                   (the paper's)
first      p^ = p_k + tau v_k, v^ = v_k

The plan pulls a whole formation that is off its place back with k_p and k_v, and no faster, since the neighbours are
off with it. To predict that they stay off would resist the return: cohesion and alignment, stronger than k_p and k_v,
hold on to where the others are thought to be. So the returning hold predicts it. What one vehicle alone is off goes
faster, by cohesion, which a sample does not tell apart.

Where no motion is shared, the sender's own estimate nu_k of the common velocity stands for v_d, and its rate a_k fades:

         v_d(t_k + tau) = nu_k + a_k T_a (1 - e^(-tau/T_a)),   p_ref(t) - p_ref(t_k) its integral
"""

from dataclasses import dataclass
from math import cos, exp, hypot, sin, sqrt
from typing import Literal, NamedTuple, Protocol

from companion.core.frames import Ned, new
from companion.core.trajectory.fleet import Reference
from companion.core.values import CommonMotion, PeerSample

RATE_FADES_S = 2.0
"""T_a: how long a common velocity goes on changing as it did"""
PlainKind = Literal["damped", "zero", "first"]


class Held(NamedTuple):
    """A sample carried on to another time."""

    position_ned_m: Ned
    velocity_ned_m_s: Ned
    told: tuple[float, ...]
    """the law's own numbers (`Law.fields`) as they are by then"""


class HoldBounds(NamedTuple):
    """What others must reckon with in a hold, for samples of vehicles that keep a speed limit."""

    braking_m_s2: float
    """most acceleration beside the plan's that it predicts"""
    drift_m_s: float
    """most speed of a sample that it leaves out of the prediction"""
    gained_m_s: float
    """most speed that it adds to those of sample and plan"""


class Hold(Protocol):
    """What a vehicle in formation is taken to do after a sample: a pure function, in all vehicles the same."""

    def at(self, sample: PeerSample, then: tuple[Ned, Ned], now: Reference, tau_s: float) -> Held:
        """A sample `tau_s` old (>= 0), carried on to now.

        `then` is p_ref and v_d of the sender's slot at the sample's time, `now` its reference now. Where no motion is
        shared both have the sender's own account of the common motion in them, and of the places only their difference
        has a meaning.
        """
        ...

    def told_error_m(self, foreseen: tuple[float, ...], tells: tuple[float, ...]) -> float:
        """How far off the peers are by the law's own numbers alone, as they foresee them and as they are (m); 0 where
        that is of no moment. Triggers look at it (`Situation.error_told_m`)."""
        ...

    def bounds(self, speed_max_m_s: float) -> HoldBounds:
        """What the error bound of a silent peer has to count in."""
        ...


class Weights(NamedTuple):
    """How much of plan and of own motion a sample of a given age keeps."""

    plan: float
    """1: the prediction moves with the plan; 0: it ignores it"""
    position: float
    """seconds by which the velocity relative to the plan carries the position on"""
    velocity: float
    """the part of the velocity relative to the plan that is left"""


def weights(kind: PlainKind, tau_s: float, damping_s: float) -> Weights:
    """Weights of a sample tau_s old; a sample from the future (clocks apart) counts as new."""
    tau_s = max(tau_s, 0.0)
    if kind == "damped":
        return damped(tau_s, damping_s)
    return first(tau_s) if kind == "first" else zero()


def damped(tau_s: float, damping_s: float) -> Weights:
    """Weights of the damped hold with time constant T_d = damping_s."""
    left = exp(-tau_s / damping_s)
    return Weights(1.0, damping_s * (1.0 - left), left)


def zero() -> Weights:
    """Weights of the zero-order hold: the sample as it was."""
    return Weights(0.0, 0.0, 1.0)


def first(tau_s: float) -> Weights:
    """Weights of the first-order hold: the sample's own velocity goes on."""
    return Weights(0.0, tau_s, 1.0)


class Response(NamedTuple):
    """e(tau) = ee e_k + ed e'_k and e'(tau) = de e_k + dd e'_k."""

    ee: float
    ed: float
    de: float
    dd: float


def response(tau_s: float, k_d: float, k_p: float) -> Response:
    """Free response of e'' + k_d e' + k_p e = 0 after tau_s."""
    half = 0.5 * k_d
    discriminant = half * half - k_p
    decay = exp(-half * tau_s)
    if discriminant > 1e-9:
        root = sqrt(discriminant)
        slow, fast = exp((root - half) * tau_s), exp((-root - half) * tau_s)
        c, s = 0.5 * (slow + fast), 0.5 * (slow - fast) / root
    elif discriminant < -1e-9:
        root = sqrt(-discriminant)
        c, s = decay * cos(root * tau_s), decay * sin(root * tau_s) / root
    else:
        c, s = decay, decay * tau_s
    return Response(c + half * s, s, -k_p * s, c - half * s)


class Pull(NamedTuple):
    """How a law pulls a vehicle back to its place: its gains and limits."""

    k_v: float
    """1/s"""
    k_p: float
    """1/s^2"""
    saturation_m: float
    """norm at which its position error saturates"""
    a_max_m_s2: float


def share_within(k_d: float, k_p: float, off_m: float, rate_m_s: float, a_max_m_s2: float) -> float:
    """The part of a response from that place and velocity of which no acceleration is larger than the limit.

    k_p e^2 + e'^2 and k_p e'^2 + e''^2 never grow: so |e''| <= k_p |e_k| + sqrt(k_d^2 + k_p) |e'_k|.
    """
    return min(1.0, a_max_m_s2 / max(k_p * off_m + sqrt(k_d * k_d + k_p) * rate_m_s, 1e-12))


def returning(tau_s: float, off_m: float, rate_m_s: float, pull: Pull, damped: Weights) -> Response:
    """The response to the pull from that far off and that fast, relative to the place and its motion.

    What is beyond the law's saturation stays where it is; what is beyond its limit is damped.
    """
    heeded = 1.0 if off_m <= pull.saturation_m else pull.saturation_m / off_m
    share = share_within(pull.k_v, pull.k_p, heeded * off_m, rate_m_s, pull.a_max_m_s2)
    r, rest = response(tau_s, pull.k_v, pull.k_p), 1.0 - share
    return Response(
        1.0 + heeded * share * (r.ee - 1.0),
        share * r.ed + rest * damped.position,
        heeded * share * r.de,
        share * r.dd + rest * damped.velocity,
    )


def axis(
    p: float, v: float, ref_then: float, vref_then: float, ref_now: float, vref_now: float, w: Weights
) -> tuple[float, float]:
    """Predicted position (m) and velocity (m/s) of one axis from the sample (p, v)."""
    relative = v - w.plan * vref_then
    return (
        p + w.plan * (ref_now - ref_then) + w.position * relative,
        w.plan * vref_now + w.velocity * relative,
    )


@dataclass(frozen=True, slots=True)
class PlainHold:
    """`Hold` by the kinds that know nothing of the law, of position and velocity; the law's numbers stay what they
    were."""

    kind: PlainKind
    damping_s: float

    def at(self, sample: PeerSample, then: tuple[Ned, Ned], now: Reference, tau_s: float) -> Held:
        """See `Hold`."""
        w = weights(self.kind, tau_s, self.damping_s)
        p, v = sample.position_ned_m, sample.velocity_ned_m_s
        then_p, then_v = then
        now_p, now_v = now.position_ned_m, now.velocity_ned_m_s
        x, vx = axis(p.north, v.north, then_p.north, then_v.north, now_p.north, now_v.north, w)
        y, vy = axis(p.east, v.east, then_p.east, then_v.east, now_p.east, now_v.east, w)
        z, vz = axis(p.down, v.down, then_p.down, then_v.down, now_p.down, now_v.down, w)
        return new(Held, (new(Ned, (x, y, z)), new(Ned, (vx, vy, vz)), sample.told))

    def told_error_m(self, foreseen: tuple[float, ...], tells: tuple[float, ...]) -> float:
        """0."""
        del foreseen, tells
        return 0.0

    def bounds(self, speed_max_m_s: float) -> HoldBounds:
        """The damped hold brakes what relative velocity there is, the paper's lets it stand."""
        braking = speed_max_m_s / self.damping_s if self.kind == "damped" else 0.0
        return HoldBounds(braking, speed_max_m_s if self.kind == "zero" else 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class ReturningHold:
    """`Hold` by the law's own pull to the plan; the vertical, which is flown by position, and flight without a plan,
    which has no place to be pulled to, are held damped."""

    pull: Pull
    plain: PlainHold

    def at(self, sample: PeerSample, then: tuple[Ned, Ned], now: Reference, tau_s: float) -> Held:
        """See `Hold`."""
        if not now.shared:
            return self.plain.at(sample, then, now, tau_s)
        p, v = sample.position_ned_m, sample.velocity_ned_m_s
        then_p, then_v = then
        now_p, now_v = now.position_ned_m, now.velocity_ned_m_s
        north, east = p.north - then_p.north, p.east - then_p.east
        v_north, v_east = v.north - then_v.north, v.east - then_v.east
        w = damped(tau_s, self.plain.damping_s)
        ee, ed, de, dd = returning(tau_s, hypot(north, east), hypot(v_north, v_east), self.pull, w)
        z, vz = axis(p.down, v.down, then_p.down, then_v.down, now_p.down, now_v.down, w)
        place = now_p.north + ee * north + ed * v_north, now_p.east + ee * east + ed * v_east, z
        velocity = now_v.north + de * north + dd * v_north, now_v.east + de * east + dd * v_east, vz
        return new(Held, (new(Ned, place), new(Ned, velocity), sample.told))

    def told_error_m(self, foreseen: tuple[float, ...], tells: tuple[float, ...]) -> float:
        """0."""
        return self.plain.told_error_m(foreseen, tells)

    def bounds(self, speed_max_m_s: float) -> HoldBounds:
        """The response within the law's limit, what is beyond that damped; the vertical is damped alone.

        The place adds to the speed what k_p e^2 + e'^2, which never grows, has from it.
        """
        k_v, k_p, off_m, a_max = self.pull
        damped_m_s2 = self.plain.bounds(speed_max_m_s).braking_m_s2
        share = share_within(k_v, k_p, off_m, speed_max_m_s, a_max)
        asked = hypot(k_v * speed_max_m_s + k_p * off_m, sqrt(k_p) * speed_max_m_s)
        braking = asked if share == 1.0 else a_max + (1.0 - share) * damped_m_s2
        return HoldBounds(max(braking, damped_m_s2), 0.0, sqrt(k_p) * off_m)


class CommonWay(NamedTuple):
    """What a published common motion makes of a time since."""

    north_m: float
    """by so much the fleet has gone on"""
    east_m: float
    north_m_s: float
    """and so fast it is now"""
    east_m_s: float


def common_way(common: CommonMotion, tau_s: float) -> CommonWay:
    """The way and the velocity tau_s after a common motion was published."""
    gained_s = RATE_FADES_S * (1.0 - exp(-tau_s / RATE_FADES_S))
    way_s2 = RATE_FADES_S * (tau_s - gained_s)
    return CommonWay(
        common.north_m_s * tau_s + common.north_m_s2 * way_s2,
        common.east_m_s * tau_s + common.east_m_s2 * way_s2,
        common.north_m_s + common.north_m_s2 * gained_s,
        common.east_m_s + common.east_m_s2 * gained_s,
    )
