"""How the companions' loops ran: gaps between setpoints, traffic, CPU."""

from collections.abc import Sequence
from typing import Literal

import numpy as np

from companion.core.events import PhaseChanged
from companion.core.values import FLYING_PHASES
from sim.launch.summary.flight import Array, Flight
from sim.launch.summary.numbers import rounded


def sent_gap_max_s(flight: Flight) -> float | None:
    """Longest time between two setpoints that companions sent while they steered; None if nobody did."""
    longest = 0.0
    for i, rows in flight.ticks.items():
        sent = rows["fleet_ns"][rows["steered"]]
        ends = [
            t for t, k, e in flight.events if k == i and isinstance(e, PhaseChanged) and e.after not in FLYING_PHASES
        ]
        for k in np.argsort(-np.diff(sent)):
            before, after = sent[k], sent[k + 1]
            if not any(before <= t <= after for t in ends):
                longest = max(longest, float(after - before) * 1e-9)
                break
    return longest or None


def sent_per_vehicle_s(
    flight: Flight, ids: Sequence[int], window: tuple[int, int], what: Literal["packets_sent", "bytes_sent"]
) -> float | None:
    """Packets or bytes a vehicle a second, from the counters told each second: between two of them they are taken to
    rise evenly, so that a window shorter than their distance has a figure too."""
    rates = []
    for i in ids:
        rows = flight.traffic.get(i)
        if rows is not None and len(rows) > 1:
            begin, end = max(window[0], rows["fleet_ns"][0]), min(window[1], rows["fleet_ns"][-1])
            if end > begin:
                sent = np.interp([begin, end], rows["fleet_ns"], rows[what])
                rates.append((sent[1] - sent[0]) / ((end - begin) * 1e-9))
    return rounded(float(np.mean(rates))) if rates else None


def cpu_per_tick_ms(rows: Sequence[Array]) -> float | None:
    """Mean over the vehicles of the whole process's CPU time per control tick (ms)."""
    costs = [float(t["cpu_ns"][-1] - t["cpu_ns"][0]) / (len(t) - 1) * 1e-6 for t in rows if len(t) > 1]
    return rounded(float(np.mean(costs))) if costs else None
