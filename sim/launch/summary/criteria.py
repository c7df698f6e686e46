"""What a flight must meet to count as passed."""

from collections.abc import Mapping
from typing import Any

from companion.config import FleetConfig

TOUCHDOWN_MAX_M_S = 2.0
"""nobody comes down faster than this just above the ground: PX4 lands at 0.7 m/s, and a fall from 0.2 m ends at this"""
SHAPE_SHARE = 0.075
"""of the spacing: how far the formation may be from its shape"""
SETPOINT_GAP_MAX_S = 0.5
"""half of the COM_OF_LOSS_T of 1.0 s after which the autopilot's failsafe acts"""


def criteria(summary: Mapping[str, Any], config: FleetConfig, centroid_limit_m: float) -> list[dict[str, Any]]:
    """What a flight must meet to count as passed."""
    source = "steady" if summary["judged_by"] == "truth" else "believed"
    distance = "minimum_distance_m" if source == "steady" else "believed.minimum_distance_m"
    nearest = (summary if source == "steady" else summary["believed"])["minimum_distance_m"]
    spacing = config.formation.spacing_m
    rows: list[tuple[str, Any, str, float]] = [
        *([(distance, nearest, ">=", 0.3 * spacing)] if len(config.vehicles) > 1 else []),
        (f"{source}.formation_error_rms_m", summary[source]["formation_error_rms_m"], "<=", SHAPE_SHARE * spacing),
        *(
            [(f"{source}.centroid_error_rms_m", summary[source]["centroid_error_rms_m"], "<=", centroid_limit_m)]
            if config.plan.kind == "legs"
            else []
        ),
        ("setpoint_gap_max_s", summary["setpoint_gap_max_s"], "<=", SETPOINT_GAP_MAX_S),
        *([("touchdown_max_m_s", summary["touchdown_max_m_s"], "<=", TOUCHDOWN_MAX_M_S)] if source == "steady" else []),
        ("failsafes", len(summary["failsafes"]), "<=", 0),
        ("vehicles killed", len(summary["killed"]), "<=", 0),
        ("autopilots lost", len(summary["autopilots_lost"]), "<=", 0),
        ("vehicles not landed and disarmed", sum(not x for x in summary["landed"].values()), "<=", 0),
        ("recordings not whole", len(summary["unrecorded"]), "<=", 0),
        ("companions lost", len(summary["lost"]), "<=", 0),
    ]
    return [
        {
            "what": what,
            "value": value,
            "limit": f"{relation} {limit:g}",
            "met": value is not None and (value >= limit if relation == ">=" else value <= limit),
        }
        for what, value, relation, limit in rows
    ]
