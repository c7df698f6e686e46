"""The core's own functions, compiled as they are. Imported only once numba is wanted."""

from collections.abc import Callable
from hashlib import blake2s
from math import sqrt
from pathlib import Path
from types import FunctionType
from typing import Any, TypeVar, cast

import numba
from numba import config as numba_config

from companion.config import law_tables
from companion.core import estimate, values, vectors
from companion.core import prediction as hold
from companion.core.law import consensus, evasion, intent, paper
from companion.core.law import starling as law
from companion.core.neighbours import gates
from companion.core.safety import avoidance, program
from companion.core.safety import filter as safety
from companion.core.trigger import error, near, periodic, switching
from sim.swarm import baselines
from sim.swarm.state import Floats

F = TypeVar("F", bound=Callable[..., Any])

_MODULES = (
    avoidance, baselines, consensus, error, estimate, evasion, gates, hold, intent, law, law_tables, near, paper,
    periodic, program, safety, switching, values, vectors,
)  # fmt: skip


def source_hash() -> str:
    """A digest of every file that these kernels are made of: names their compiled code and the results made by it."""
    digest = blake2s(digest_size=8)
    for path in [*(Path(str(m.__file__)) for m in _MODULES), *sorted(Path(__file__).parent.glob("*.py"))]:
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


def _length(x: float, y: float, z: float) -> float:
    """`math.hypot` of three: numba has it of two only."""
    return sqrt(x * x + y * y + z * z)


def _plane(g_north: float, g_east: float, b: float) -> safety.HalfPlane:
    """A half-plane with its fields' defaults, which numba does not know."""
    return safety.HalfPlane(g_north, g_east, b, 0, 0.0, 0.0)


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
response = compiled(hold.response)
share_within = compiled(hold.share_within)
returning = compiled(hold.returning, response=response, share_within=share_within)
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
push_m_s2 = compiled(safety.push_m_s2)
resting_push_m_s2 = compiled(safety.resting_push_m_s2, push_m_s2=push_m_s2, barrier=barrier, HalfPlane=compiled(_plane))
near_push_m_s2 = compiled(near.near_push_m_s2, resting_push_m_s2=resting_push_m_s2, hypot=compiled(_length))
on_edge = compiled(program.on_edge)
best = compiled(program.best, on_edge=on_edge)
give_way = compiled(program.give_way, best=best)
solve = compiled(program.solve, best=best, give_way=give_way)
sidestep = compiled(avoidance.sidestep)
avoid: Callable[[float, float, float, float, Floats, int, int, float, Floats], avoidance.Avoidance] = compiled(
    cast(Any, avoidance.avoid), sidestep=sidestep, solve=solve
)
is_outlier = compiled(gates.is_outlier)
saturated = compiled(consensus.saturated)
common_way = compiled(hold.common_way)
away = compiled(evasion.away)
share_fled = compiled(evasion.share_fled)
evasive_wish = compiled(evasion.wish, away=away, share_fled=share_fled)
evade = compiled(evasion.evade, away=away, wish=evasive_wish)
common_velocity_rate = compiled(consensus.common_velocity_rate)
anchor_rate = compiled(intent.anchor_rate, saturated=saturated)
intent_rest = compiled(intent.rest, saturated=saturated)
anchor_axis = compiled(intent.anchor_axis)
anchor_exceeds = compiled(intent.anchor_exceeds)
classic_threshold = compiled(baselines.classic_threshold)
elastic_threshold = compiled(baselines.elastic_threshold)
observer_axis = compiled(baselines.observer_axis)
other_separation = compiled(baselines.other_separation)
