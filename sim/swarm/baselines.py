"""What is compared with the flown law: rules of other papers, plain scalar functions compiled in `sim.swarm.kernels`.

All of them fly under the same dynamics, disturbances, seeds, gains and starts as the rest; only what is written here
differs. The sources give these rules for other plants or without all parameters; every guess is named.
"""

from math import exp, sqrt

from companion.core.law.starling import DISTANCE_FLOOR_M, Gains


def classic_threshold(n: float, z2: float, sigma: float, a: float) -> float:
    """Largest |e_i|^2 without a message, of Dimarogonas, Frazzoli, Johansson (IEEE TAC 57(5), 2012), their Eq. (10):

        |e_i|^2 <= sigma a (1 - a |N_i|) / |N_i| |z_i|^2,      z_i = sum_j (x_i - x_j),  0 < a < 1/|N_i|

    Guesses. The rule is for single integrators: e takes the weighted form |e_p|^2 + gamma |e_v|^2 of Eq. (4) and z_i
    the formation residuals sum_j (p_i - p^_j - d_ij), with what was broadcast in place of the true neighbours. Table 2
    calls gamma_1 = 0.6 a threshold gain (sigma) and gamma_2 the second parameter (a), given as 0.3 there and 0.15 in
    the text. With a |N_i| >= 1 the rule's own condition is broken: the threshold is not positive, so every step sends.
    """
    return sigma * a * (1.0 - a * n) / max(n, 1.0) * z2


def elastic_threshold(mean_residual_2: float, t_s: float, coefficient: float, amplitude: float, rate: float) -> float:
    """Largest |e_i|^2 without a message, of the resilient ("elastic") distributed trigger, reference [25].

    The text names an observer gain of 2, an observer threshold coefficient of 0.1 and a recovery time of 1 s, Table 2
    r = 0.4 as decay factor and epsilon = 5. Guesses: a threshold relative to the squared mean formation residual with
    that coefficient, plus a decaying part that is either epsilon e^(-r t) or r e^(-epsilon t) (both are studied);
    neighbours are not held but followed by the observer below.
    """
    return coefficient * mean_residual_2 + amplitude * exp(-rate * t_s)


def observer_axis(p: float, v: float, sent_p: float, sent_v: float, gain: float, dt_s: float) -> tuple[float, float]:
    """One step of the elastic trigger's observer: p' = v + L (p_k - p), v' = L (v_k - v), L the observer gain (1/s).

    Guess: the source observes through a switching topology; on a connected one its observer is this relaxation toward
    what was last sent, carried on with the observed velocity.
    """
    return p + dt_s * (v + gain * (sent_p - p)), v + dt_s * gain * (sent_v - v)


CUT, GRADIENT, UNCUT = 0, 1, 2


def other_separation(kind: int, dx: float, dy: float, dz: float, g: Gains) -> tuple[float, float, float]:
    """What other readings of "phi_s grad_p" add to `law.pair`'s separation (m/s^2), which ends at r0.

    UNCUT: phi_s also beyond r0, where it is negative and attracts. GRADIENT: -grad phi_s = 2/r^3 within r0 instead.
    """
    r = max(sqrt(dx * dx + dy * dy + dz * dz), DISTANCE_FLOOR_M)
    phi = 1.0 / (r * r) - 1.0 / (g.r0 * g.r0)
    cut = max(phi, 0.0)
    size = 0.0
    if kind == UNCUT:
        size = g.k_s * (phi - cut) / r
    elif kind == GRADIENT:
        size = g.k_s * ((2.0 / (r * r * r) if r < g.r0 else 0.0) - cut) / r
    return size * dx, size * dy, size * dz
