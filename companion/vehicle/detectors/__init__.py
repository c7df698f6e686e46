"""The detectors: one for each row of the table of failsafes that a supervisor can notice (`NoticedBy.DETECTOR`)."""

from companion.vehicle.detectors import autopilot, battery, peers, position
from companion.vehicle.detectors.base import Detector, Finding, Note

DETECTORS: tuple[type[Detector], ...] = (
    autopilot.HeartbeatLost,
    battery.BatteryUnknown,
    autopilot.LeftByPilot,
    autopilot.LeftByAutopilot,
    position.PositionStale,
    position.PositionFrozen,
    position.PositionLost,
    position.PositionUncertain,
    position.PositionJumpsOn,
    position.PositionJumped,
    autopilot.NotFollowed,
    battery.BatteryCritical,
    battery.BatteryLow,
    autopilot.NotArmed,
    autopilot.NoTakeOff,
    autopilot.AltitudeNotReached,
    peers.OthersMissing,
    peers.Deaf,
    peers.Alone,
    peers.AloneForLong,
    peers.DetachedForLong,
)
"""in the order in which they are asked: where two would act at a time, the first one does"""

__all__ = ["DETECTORS", "Detector", "Finding", "Note"]
