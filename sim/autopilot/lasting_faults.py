"""Faults of the stub that have an end: what each breaks, and when it is whole again. Sans-I/O."""

from dataclasses import replace

from companion.core.frames import Ned
from sim.autopilot.dynamics import Vehicle
from sim.autopilot.estimator import Estimator
from sim.autopilot.faults import Fault, FaultKind
from sim.autopilot.link import Link
from sim.autopilot.telemetry import Telemetry


class LastingFaults:
    """Those that are there; a boot ends them all."""

    def __init__(self, estimator: Estimator, telemetry: Telemetry, link: Link, vehicle: Vehicle) -> None:
        self._vehicle = vehicle
        self._calm = Ned(vehicle.parameters.wind_north_m_s, vehicle.parameters.wind_east_m_s, 0.0)
        """the wind that there is without a fault"""
        self._estimator = estimator
        self._telemetry = telemetry
        self._link = link
        self._ends_ns: dict[FaultKind, float] = {}

    def order(self, fault: Fault, now_ns: int) -> None:
        """One begins for as long as it says, or ends where it says 0 s."""
        begins = fault.duration_s > 0.0
        if fault.kind is FaultKind.WIND:
            self._blow(fault.wind_ned_m_s if begins else self._calm)
        else:
            self._set(fault.kind, fault.strength, now_ns, begins=begins)
        if begins:
            self._ends_ns[fault.kind] = now_ns + fault.duration_s * 1e9
        else:
            self._ends_ns.pop(fault.kind, None)

    def end_due(self, now_ns: int) -> None:
        """End those whose time is over."""
        if self._ends_ns:
            for kind in [kind for kind, end_ns in self._ends_ns.items() if now_ns >= end_ns]:
                del self._ends_ns[kind]
                self._set(kind, 0.0, now_ns, begins=False)

    def _blow(self, wind_ned_m_s: Ned) -> None:
        self._vehicle.parameters = replace(
            self._vehicle.parameters, wind_north_m_s=wind_ned_m_s.north, wind_east_m_s=wind_ned_m_s.east
        )

    def _set(self, kind: FaultKind, strength: float, now_ns: int, *, begins: bool) -> None:
        match kind:
            case FaultKind.GPS_LOST:
                if begins:
                    self._estimator.lose_gps(strength, now_ns)
                else:
                    self._estimator.regain_gps()
            case FaultKind.POSITION_FROZEN:
                self._estimator.freeze(begins)
            case FaultKind.NOISE:
                self._estimator.add_noise(strength if begins else 0.0)
            case FaultKind.LOW_BATTERY:
                self._telemetry.battery_forced = strength if begins else None
            case FaultKind.MUTE | FaultKind.LINK_LOST:
                self._link.muted = begins
                self._link.deaf = begins and kind is FaultKind.LINK_LOST
                self._link.forget()
            case FaultKind.WIND:
                self._blow(self._calm)
            case FaultKind.SLOW_LINK:
                self._link.bytes_per_s = max(strength, 1.0) if begins else float("inf")
