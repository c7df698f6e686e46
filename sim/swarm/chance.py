"""The swarm's random numbers, compiled: a number of a stream by key and counter, so that no draw depends on another."""

import math

import numpy as np

from sim.swarm.compiled import kernel

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
