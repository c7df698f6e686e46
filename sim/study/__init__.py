"""Studies: figures of the laws and triggers over many seeds, in the swarm or with real agents in lockstep."""

STUDIES = ("example1", "example2", "table3", "readings", "pareto", "worth", "faults", "evasion", "scale", "theory")
FLOWN_STUDIES = ("headon", "messages", "campaign")
"""studies that fly the real agents in lockstep: minutes to hours, so `all` leaves them out"""
