"""What a flight was like: one account for stubs, PX4 and lockstep, from true states and from what was sent.

Errors are computed from the vehicles' true motion (the stubs' or the simulator's), not from what companions believed;
what they believed stands beside it, and is judged where nobody knows the truth (vehicles in the field).
"""

from typing import Any

import numpy as np

from companion.core.events import FailsafeActed, Killed
from companion.wire.px4 import Px4Mode
from sim.launch.summary.believed import STEP_NS, believed_errors, estimate_errors, times_of
from sim.launch.summary.believed import minimum_distance_m as believed_minimum_m
from sim.launch.summary.criteria import SHAPE_SHARE, criteria
from sim.launch.summary.flight import TICK_ROWS, Command, Flight
from sim.launch.summary.loops import cpu_per_tick_ms, sent_gap_max_s, sent_per_vehicle_s
from sim.launch.summary.numbers import per_vehicle, percentiles, rms, rounded, step_s
from sim.launch.summary.steady import errors_from_slots, formed_apart, formed_ns, steady_at
from sim.launch.summary.truth import attitude_rate_deg_s, minimum_distance, truth_of

COMMANDS_TOLD_MOST = 1000
REFERENCE_HZ = 20.0
BELIEVED = ("formation_error_rms_m", "velocity_error_rms_m_s", "centroid_error_rms_m", "altitude_error_max_m")


def summarise(flight: Flight) -> dict[str, Any]:
    """The flight's figures, as summary.json holds them."""
    config = flight.config
    ids = [v.id for v in config.vehicles]
    staying = flight.staying
    truth = truth_of(flight.truth, ids)
    times = truth.times_ns
    formed = formed_ns(flight, staying)
    history = flight.history()
    columns = [ids.index(i) for i in staying]
    known = len(times) > 0
    if known:
        follows = truth.flies & (truth.mode == Px4Mode.OFFBOARD)
        flown = follows[:, columns].all(axis=1)
        steady = steady_at(flight, history, times, formed) & flown
        seconds = float(steady.sum()) * step_s(times)
        window = (int(times[steady][0]), int(times[steady][-1])) if steady.any() else (0, 0)
    else:
        grid = times_of(flight, ids)
        inside = grid[steady_at(flight, history, grid, formed)]
        steady = flown = np.zeros(0, bool)
        seconds = len(inside) * STEP_NS * 1e-9
        window = (int(inside[0]), int(inside[-1])) if len(inside) else (0, 0)
    limits = (SHAPE_SHARE * config.formation.spacing_m, flight.centroid_limit_m)
    figures = errors_from_slots(
        config, history, staying, times[steady], truth.position_ned_m[steady][:, columns],
        truth.velocity_ned_m_s[steady][:, columns],
    )  # fmt: skip
    puts = [p for p in flight.puts if window[0] <= p.time_ns <= window[1] and p.vehicle_id in staying]
    rate = len(puts) / max(len(staying), 1) / seconds if seconds else None
    packets = sent_per_vehicle_s(flight, staying, window, "packets_sent")
    minimum, minimum_at_s = minimum_distance(flight.takeoff_ns, truth)
    ticks = [t for i, t in flight.ticks.items() if len(t)]
    believed = believed_errors(flight, history, staying, formed, window)
    in_window = [t[(t["fleet_ns"] >= window[0]) & (t["fleet_ns"] <= window[1])] for t in ticks]
    every = np.concatenate(in_window) if in_window else np.zeros(0, TICK_ROWS)
    driven = every[every["latency_ns"] >= 0]
    ended = truth.down if known else {i: flight.disarmed.get(i, False) for i in ids}
    gap = truth.gap_max_s if truth.gap_max_s is not None else sent_gap_max_s(flight)
    commands = sorted(flight.commands.values(), key=lambda c: (c.time_ns, c.order.id))
    summary: dict[str, Any] = {
        "vehicles": len(ids),
        "judged_by": "truth" if known else "the vehicles' own estimates",
        "formed_after_s": None if formed is None else rounded((formed - flight.takeoff_ns) * 1e-9),
        **formed_apart(flight, history, staying, times[flown], truth.position_ned_m[flown][:, columns], limits),
        "minimum_distance_m": minimum,
        "minimum_distance_at_s": minimum_at_s,
        "steady": {
            "seconds": rounded(seconds),
            **figures,
            "messages_per_vehicle_hz": rounded(rate, 5),
            "reduction_vs_20hz_percent": None if rate is None else rounded(100.0 * (1.0 - rate / REFERENCE_HZ), 3),
            "payload_bytes_per_vehicle_s": rounded(per_vehicle(sum(p.size for p in puts), staying, seconds)),
            "network": config.peers.network,
            "packets_per_vehicle_hz": packets,
            "packets_reduction_vs_20hz_percent": packets_reduction_percent(packets, len(staying)),
            "wire_bytes_per_vehicle_s": sent_per_vehicle_s(flight, staying, window, "bytes_sent"),
            "attitude_rate_rms_deg_s": attitude_rate_deg_s(flight.truth, window),
        },
        "believed": {
            **{k: believed[k] for k in BELIEVED},
            "slot_error_rms_m": rounded(rms(every["position_error_m"])) if len(every) else None,
            "minimum_distance_m": believed_minimum_m(flight, ids),
            "nearest_neighbour_m": rounded(float(every["nearest_m"].min())) if len(every) else None,
        },
        "estimates": estimate_errors(flight, history, staying, formed, window, times, truth.position_ned_m[:, columns]),
        "setpoint_rate_hz": rounded(per_vehicle(float(every["steered"].sum()), ids, seconds)) if len(every) else None,
        "setpoint_gap_max_s": rounded(gap),
        "loop_lateness_ms": percentiles(every["lateness_ns"]),
        "latency_ms": percentiles(driven["latency_ns"]),
        "reference_lateness_ms": percentiles(flight.reference_lateness_ns),
        "cpu_per_tick_ms": cpu_per_tick_ms(in_window),
        "landed": ended,
        "touchdown_max_m_s": rounded(truth.touchdown_m_s),
        "killed": {i: e.cause.value for _, i, e in flight.events if isinstance(e, Killed)},
        "unrecorded": dict(flight.unrecorded),
        "lost": sorted(flight.lost),
        "autopilots_lost": dict(flight.autopilots_lost),
        "failsafes": [f"vehicle {i}: {e.sentence}" for _, i, e in flight.events if isinstance(e, FailsafeActed)],
        "commands": [_command(c, flight.takeoff_ns) for c in commands[:COMMANDS_TOLD_MOST]],
        "commands_left_out": flight.commands_unread + max(len(commands) - COMMANDS_TOLD_MOST, 0),
        "rejected": dict(flight.rejected),
        "control_rate_hz": config.limits.control_rate_hz,
        "seed": flight.seed,
        "versions": dict(flight.versions),
    }
    summary["criteria"] = criteria(summary, config, flight.centroid_limit_m)
    return {"passed": all(c["met"] for c in summary["criteria"]), **summary}


def packets_reduction_percent(packets_hz: float | None, vehicles: int) -> float | None:
    """How many packets fewer than at 20 Hz, at least: there each state is one to each peer, acknowledgements left out.

    None where nothing was sent over a network, or there are no peers.
    """
    least = REFERENCE_HZ * (vehicles - 1)
    return None if packets_hz is None or least <= 0 else rounded(100.0 * (1.0 - packets_hz / least), 2)


def _command(command: Command, takeoff_ns: int) -> dict[str, Any]:
    order = command.order
    return {
        "at_s": rounded((command.time_ns - takeoff_ns) * 1e-9),
        "verb": order.verb,
        "id": order.id,
        "issuer": order.issuer,
        "accepted": sorted(command.accepted),
        "refused": dict(sorted(command.refused.items())),
        "unanswered": sorted(command.unanswered),
    }
