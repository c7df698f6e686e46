"""A law and a trigger for starling-fleet, as an example."""
