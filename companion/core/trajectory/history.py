"""The trajectories that a vehicle knows."""

from dataclasses import dataclass

from companion.core.trajectory.fleet import FleetTrajectory, Reference


@dataclass(slots=True)
class TrajectoryHistory:
    """The motions a vehicle knows: the newest, and those before it, for samples made under them."""

    motions: list[FleetTrajectory]

    @property
    def newest(self) -> FleetTrajectory:
        """The motion that wins so far; it may start in the future."""
        return self.motions[-1]

    def adopt(self, motion: FleetTrajectory) -> bool:
        """Take a motion if it is larger than the newest; one that replaces another of its revision replaces it."""
        if motion.order <= self.newest.order:
            return False
        kept = [m for m in self.motions if m.revision < motion.revision]
        self.motions = [*kept[-3:], motion]
        return True

    def at(self, fleet_ns: int) -> FleetTrajectory:
        """The motion in force at a time: the newest that has started."""
        for motion in reversed(self.motions):
            if fleet_ns >= motion.start_ns:
                return motion
        return self.motions[0]

    def reference(self, vehicle_id: int, fleet_ns: int) -> Reference:
        """A vehicle's reference at a time under the motion then in force."""
        return self.at(fleet_ns).reference(vehicle_id, fleet_ns)
