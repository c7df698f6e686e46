"""The parts of the stand-in PX4; `sim.autopilot.Autopilot` puts them together."""
