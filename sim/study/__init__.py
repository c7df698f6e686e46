"""Studies: figures of the laws and triggers over many seeds, in the swarm or with real agents in lockstep."""

STUDIES = ("example1", "example2", "table3", "readings", "pareto", "worth", "faults", "evasion", "scale", "theory")
FLOWN_STUDIES = ("headon", "messages", "campaign")
PX4_STUDIES = ("campaign_px4",)
"""flown on real PX4 in SITL: `fleet study campaign --autopilot px4`"""
FLOWN = FLOWN_STUDIES + PX4_STUDIES
"""studies that fly the real agents in lockstep: minutes to hours, so `all` leaves them out"""
