"""A set-up of the swarm as the kernels take it: plain numbers, who heeds whom, the rules' thresholds.

Nothing here needs numba.
"""

import math
from collections.abc import Mapping

import numpy as np

from companion.config.bounds import SPACING_MARGIN_M
from companion.core.law.intent import IntentGains, IntentTrigger
from companion.core.law.starling import Gains
from companion.core.prediction import Pull
from companion.core.trigger.error import ErrorTrigger
from companion.core.trigger.near import HOLD_S as NEAR_HOLD_S
from companion.core.trigger.near import near_bound_m
from companion.core.trigger.switching import SwitchingTrigger
from sim.swarm.baselines import CUT, GRADIENT, UNCUT
from sim.swarm.setup import DENSE_MAX, Hold, Separation, Setup, Trigger
from sim.swarm.state import (
    CLASSIC,
    ELASTIC,
    ERROR,
    FLOAT_CLOCK,
    HOLD_DAMPED,
    HOLD_FIRST,
    HOLD_OBSERVER,
    HOLD_RETURNING,
    HOLD_ZERO,
    INTENT,
    PERIODIC,
    SWITCHING,
    Flags,
    Floats,
    Options,
)


def linked_pairs(setup: Setup) -> Flags:
    """Which ordered pairs alignment and cohesion heed, in the order of the rows; empty: all."""
    n = setup.formation.count
    if not setup.nearest:
        return np.zeros(0, dtype=np.uint8)
    slots = setup.formation.slots()
    apart = np.linalg.norm(slots[:, None] - slots[None, :], axis=2)
    linked = np.zeros((n, n), dtype=np.uint8)
    for i, order in enumerate(np.argsort(apart, axis=1, kind="stable")):
        linked[i, order[order != i][: setup.nearest]] = 1
    linked |= linked.T
    return linked[~np.eye(n, dtype=bool)]


def near_uncertainty_m(setup: Setup) -> Floats:
    """Uncertainty of a near peer by the age of its sample in steps (m); empty without near mode."""
    steps = round(setup.t_max_s / setup.dt_s) + 1 if setup.near else 0
    motion = setup.peer_motion
    return np.array([near_bound_m(k * setup.dt_s, setup.uncertainty_m, motion) for k in range(steps)])


_HOLDS: Mapping[Hold, int] = {
    "zero": HOLD_ZERO, "first": HOLD_FIRST, "damped": HOLD_DAMPED, "returning": HOLD_RETURNING,
    "observer": HOLD_OBSERVER,
}  # fmt: skip
_TRIGGERS: Mapping[Trigger, int] = {
    "error": ERROR, "switching": SWITCHING, "periodic": PERIODIC, "float clock": FLOAT_CLOCK, "classic": CLASSIC,
    "elastic": ELASTIC, "intent": INTENT,
}  # fmt: skip
_SEPARATIONS: Mapping[Separation, int] = {"cut": CUT, "attracting": CUT, "gradient": GRADIENT, "uncut": UNCUT}


def gains(setup: Setup) -> Gains:
    """The law's gains; the literal sign of the printed separation is a negative k_s."""
    k_s = -setup.k_s if setup.separation == "attracting" else setup.k_s
    return Gains(
        k_s, setup.k_a, setup.k_c, setup.k_v, setup.k_p, setup.r0_m, setup.a_max_m_s2, setup.saturation_m,
        setup.saturation_m_s, 1.0 if setup.normalise else 0.0,
    )  # fmt: skip


def run_options(setup: Setup) -> Options:
    """The set-up as the kernels' plain numbers."""
    own_held = setup.reading in ("V1", "V1b")
    elastic = setup.trigger == "elastic"
    fault = setup.fault != "none"
    return Options(
        dt=setup.dt_s,
        dt_ns=round(setup.dt_s * 1e9),
        every=setup.control_every,
        hold=_HOLDS[setup.hold],
        damping=setup.damping_s,
        pull=Pull(setup.k_v, setup.k_p, setup.saturation_m, setup.a_max_m_s2),
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
        uncertainty=setup.uncertainty_m,
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
        near=int(setup.near),
        near_period_ns=round(setup.near_period_s * 1e9),
        near_hold=round(NEAR_HOLD_S / setup.dt_s),
        near_closest=max(setup.r0_m, setup.barrier_radius_m) + SPACING_MARGIN_M,
        near_radius=setup.barrier_radius_m,
        bound_m=setup.error_bound_m,
        threat_begins=setup.threat[0] if setup.threat else math.inf,
        dense_measures=int(setup.dense_measures and setup.formation.count <= DENSE_MAX),
    )


def rules_of(setup: Setup) -> tuple[Gains, IntentGains, ErrorTrigger, SwitchingTrigger, IntentTrigger]:
    """Gains and thresholds of every law and trigger, as the kernels take them."""
    return (
        gains(setup),
        IntentGains(
            setup.intent_k_p, setup.intent_k_d, setup.intent_c_g, setup.intent_c_max, setup.saturation_m,
            setup.saturation_m_s,
        ),
        ErrorTrigger(setup.epsilon_m, setup.gamma_s2, setup.kappa, setup.epsilon_nu_m_s),
        SwitchingTrigger(setup.gamma_s2, setup.alpha, setup.beta, setup.delta_min, setup.delta_f, setup.eta),
        IntentTrigger(setup.intent_epsilon_m, setup.intent_kappa),
    )  # fmt: skip
