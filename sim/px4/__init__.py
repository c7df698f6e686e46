"""The parts of the stand-in PX4: modes, parameters, commander, navigator, estimator, link, streams, commands, faults."""
