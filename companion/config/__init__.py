"""fleet.toml: one file for the whole fleet, validated into frozen values.

    numbers     kinds of number and the base of every table
    law_tables  the tables of law and trigger
    schema      every other table, and the file as a whole
    bounds      what follows of errors, distances and times, whoever the vehicles are
    derived     FleetConfig: what follows from the file, so that all vehicles compute the same
    checks      faults that only several values together show
    endpoints   addresses and ports of links
    messages    a fault of one value as a sentence
    file        reads and validates a file
    new_file    the text of a new one
    overrides   what a command line may change of one

Every key has a range and a unit (its suffix); an unknown key is refused. Names of units: `_m` metres, `_s` seconds,
`_m_s` metres per second, `_deg` degrees.
"""

from companion.config.derived import FleetConfig
from companion.config.file import load

__all__ = ["FleetConfig", "load"]
