"""PX4's EVENT messages (410) at the turns of a flight, as recorded. pymavlink knows no such message: packed by hand."""

import struct

from sim.autopilot.commander import Commander
from sim.autopilot.link import Link
from sim.autopilot.modes import LandedState, Mode

EVENT_MESSAGE_ID = 410
EVENT_CRC_EXTRA = 160
LOG_LEVELS = 102
"""informative, both internally and externally (6 << 4 | 6)"""
ARMED, TAKEOFF_DETECTED, LANDING_ORDERED, LANDING_DETECTED, DISARMED = (
    26266355,
    21054825,
    20099806,
    26622124,
    32794487,
)
"""event ids of the recorded flight"""
ARMED_BY_COMMAND, DISARMED_BY_LANDING = b"\x04", b"\x06"
"""their first argument"""


class EventReporter:
    """Watches a commander and says what has changed."""

    def __init__(self, link: Link, commander: Commander) -> None:
        self._link = link
        self._commander = commander
        self._armed = False
        self._on_ground = True
        self._mode = commander.mode
        self._sequence = 0

    def step(self) -> None:
        """Sends an event for every turn since the last step."""
        commander = self._commander
        armed = commander.armed
        if armed is not self._armed:
            self._armed = armed
            if armed:
                self._say(ARMED, ARMED_BY_COMMAND)
            else:
                self._say(DISARMED, DISARMED_BY_LANDING)
        on_ground = commander.landed_state is LandedState.ON_GROUND
        if on_ground is not self._on_ground:
            self._on_ground = on_ground
            self._say(LANDING_DETECTED if on_ground else TAKEOFF_DETECTED)
        if commander.mode is not self._mode:
            self._mode = commander.mode
            if self._mode is Mode.LAND and armed:
                self._say(LANDING_ORDERED)

    def _say(self, event: int, arguments: bytes = b"") -> None:
        boot_ms = self._link.now_ns // 1_000_000 & 0xFFFFFFFF
        self._sequence = (self._sequence + 1) & 0xFFFF
        payload = struct.pack("<IIHBBB40s", event, boot_ms, self._sequence, 0, 0, LOG_LEVELS, arguments)
        self._link.send_payload(EVENT_MESSAGE_ID, EVENT_CRC_EXTRA, payload)
