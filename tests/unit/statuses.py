"""A vehicle's status as it might be, for tests that look at a few of its fields."""

from typing import Any

from companion.wire.operator import Place, Status

FORMED: dict[str, Any] = {
    "vehicle": 1, "phase": "formed", "mode": "OFFBOARD", "killed": None, "armed": True, "ready": [], "unfit": [],
    "revision": 2, "fleet": "starling", "up_s": 60.0, "place": Place(7, 1, 1), "shape": "v", "moving": True,
    "position_error_m": 0.1234, "neighbours": 4, "nearest_m": 3.99, "oldest_age_s": 7.5, "messages": 17,
    "messages_by_cause": {}, "setpoints": 900, "battery_percent": 93, "autopilot_age_s": 0.5, "configuration": "c",
    "failsafes": [], "rejected": {}, "limited": {}, "own_id_heard": False, "motion": {}, "lateness_ms": 1.25,
}  # fmt: skip


def status(**more: Any) -> Status:
    """One that flies in formation, but for what is said otherwise."""
    return Status(**{**FORMED, **more})
