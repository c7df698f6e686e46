"""What people see of a flight as it goes on."""

from companion.operator.live import LiveTable
from companion.terminal import one_line
from sim.launch.processes import how_it_ended
from sim.launch.watch import Progress


class FlightView(LiveTable):
    """The live table on a terminal's error output; nothing when quiet."""

    def __init__(self, quiet: bool) -> None:
        super().__init__(quiet=quiet, to_error=True)

    def show_progress(self, progress: Progress) -> None:
        """Show the fleet as the launcher has it now."""
        ended = [f"companion {i}, {how_it_ended(s)}" for i, s in sorted(progress.ended.items())]
        ended += [f"vehicle {i}: {one_line(how)}" for i, how in sorted(progress.autopilots_ended.items())]
        self.show(progress.vehicles, progress.elapsed_s, progress.doing, ended)
