"""What a run of the swarm is, as plain numbers, and all that it changes. N agents, R rows (`sim.swarm.kernels`)."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from companion.core.law.base import FIELDS_MAX
from companion.core.prediction import Pull

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Flags = npt.NDArray[np.uint8]

HOLD_ZERO, HOLD_FIRST, HOLD_DAMPED, HOLD_OBSERVER, HOLD_RETURNING = 0, 1, 2, 3, 4
ERROR, SWITCHING, PERIODIC, FLOAT_CLOCK, CLASSIC, ELASTIC, INTENT = 0, 1, 2, 3, 4, 5, 6
TOLD = 15
"""floats of a sample's motion: flown law p, v, nu, nu'; published intent c, g, w, e, e'"""
SAMPLE = TOLD + FIELDS_MAX
"""floats of a sample: those, and what a law adds"""
DIGEST_MAX = 16
"""most samples of peers that a message carries"""
ROW = 22
"""floats of a `Neighbour`: p^ 3, v^ 3, d_ij 3, in formation, shares the avoidance, uncertainty, lost, last seen 3,
slot's velocity 3 and acceleration 3"""
NEVER = -1
ERROR_BIN_M = 0.001
ERROR_BINS = 4000
CAUSES = ("first", "heartbeat", "triggered", "near")
"""why a message was sent: the first; silence as long as T_max; the trigger, be it an error or a period; near mode"""
FIRST, HEARTBEAT, TRIGGERED, NEAR = 0, 1, 2, 3


class Options(NamedTuple):
    """What a run is, as plain numbers (metres, seconds, m/s, m/s^2)."""

    dt: float
    dt_ns: int
    every: int
    """steps per control period"""
    hold: int
    damping: float
    pull: Pull
    """of the returning hold: the law's"""
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
    near: int
    """1: near mode, see `core.trigger.near`"""
    near_period_ns: int
    near_hold: int
    """steps for which a pair stays near"""
    near_closest: float
    near_radius: float
    """the safety radius of a peer whose messages are not missing (m)"""
    bound_m: float
    """on the error of every prediction"""
    threat_begins: float
    """(s); infinite: nobody is scared"""
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
    common_rate: Floats
    """nu' (N, 3)"""
    evasion: Floats
    """what each agent remembers of a threat, as `core.law.evasion.Evasion` (N, 8)"""
    threat: Floats
    """`core.law.evasion.Threat` (6,)"""
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
    """what the peers predict of this agent (N, 6), and its anchor, or nu, of which the law has one (N, 9)"""
    residual: Floats
    """mean residual of the last control period (N, 3)"""
    neighbours: Floats
    """how many took part in it (N,)"""
    told: Floats
    """what each agent's law adds to its next message (N, FIELDS_MAX)"""
    observed: Floats
    """observer of the elastic baseline (N, 6)"""
    predicted: Floats
    """rows (R, 12): p^, v^, slot's place, anchor or nu"""
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
    """(delay + 1, N, samples of peers in a message, SAMPLE)"""
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
    error_bins: Ints
    """how many predictions were wrong by so many ERROR_BIN_M; the last one holds what is larger"""
    phase_ns: Ints
    """(N, 2): by how much each agent's periods, and near mode's, end earlier than the run's own"""
    informed: Flags
    """(N,) 1: this leaderless agent knows the motion"""
    wish: Floats
    """(steps + 1, 6): velocity and acceleration that the informed know"""
    linked: Flags
    """(R of every ordered pair,) 1: alignment and cohesion heed this pair"""
    disturbances: Floats
    """rows (agent, first step, step after the last, share of its acceleration that it gets, push 3 (m/s^2))"""
    partitions: Ints
    """rows (first step, step after the last, agents below this one hear none of the rest)"""
    joined: Ints
    """(N,): the step from which an agent hears and is heard"""
    missing: Floats
    """uncertainty of a near peer by the age of its sample in steps (m)"""
    near_until: Ints
    """(R,): the step until which a peer is near"""
    named_until: Ints
    """(N,): the same after a peer named this agent"""
    promised: Flags
    """(N,) 1: the last message said that the next one is due soon"""
    held_due: Flags
    """(R,) 1: so did the sender's last message that arrived"""
    ring_due: Flags
    """(delay + 1, N)"""
    ring_near: Flags
    """(delay + 1, N, N): whom each message names"""
    events: Ints
    """(most, 3): step, agent, cause"""
    counts: Ints
    """[number of events, bytes' samples sent, mode steps dynamic, mode steps fixed, messages that reached somebody]"""
    record: Floats
    """(steps kept, N, 6)"""
    record_common: Floats
    """nu and what the agent does about a threat (steps kept, N, 4); no rows where nobody is scared"""


ERROR_BIN_M = 0.001
ERROR_BINS = 4000
MEASURES = (
    "minimum_distance_m",
    "peak_command_m_s2",
    "bound_samples",
    "bound_violations",
    "bound_worst_ratio",
    "prediction_error_square_sum",
    "prediction_error_max_m",
)
