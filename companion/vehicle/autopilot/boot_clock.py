"""An autopilot's time since boot, on our monotonic clock."""

from collections import deque
from dataclasses import dataclass, field

LATENCY_WINDOW_NS = 1_000_000_000
"""short, since a simulated autopilot's clock may run several per cent slow: what it falls behind within the window
counts as delay"""
RATE_WINDOW_NS = 2_000_000_000
BOOT_MS_ROUND = 1 << 32
BOOT_MS_SLACK = 2_000
"""clocks and links differ by less than this between two positions (ms); no autopilot boots faster and speaks"""
REBOOT_MS = 1_000
"""a time so much earlier than the last is of another boot"""


@dataclass(slots=True)
class BootClock:
    """The autopilot's boot time on our monotonic clock: the least delayed message of the last seconds tells the offset.

    A message's age beyond that is the delay it met on its way.
    """

    _window: deque[tuple[int, int]] = field(default_factory=deque)
    """(arrival, offset), offsets rising: a monotonic queue, so that the front is the window's minimum"""
    last_boot_ms: int = -1
    """of the latest message, gone on with after 32 bit; -1: none"""
    _arrivals_ns: deque[int] = field(default_factory=lambda: deque(maxlen=512))
    """of the latest messages"""

    def restart(self) -> None:
        """Forget: the autopilot has booted anew."""
        self._window.clear()
        self.last_boot_ms = -1

    def unwrapped(self, boot_ms: int, monotonic_ns: int) -> int:
        """Time since boot whose 32 bit go round every 49.7 days, gone on with.

        A small number after a large one is a reboot, unless it is as much later as time has passed here.
        """
        last = self.last_boot_ms
        if last < 0:
            return boot_ms
        on = last - last % BOOT_MS_ROUND + boot_ms
        passed_ns = monotonic_ns - self._arrivals_ns[-1] if self._arrivals_ns else 0
        round_later = on + BOOT_MS_ROUND
        gone_round = on < last - REBOOT_MS and round_later - last <= passed_ns // 1_000_000 + BOOT_MS_SLACK
        return round_later if gone_round else on

    def rebooted(self, boot_ms: int) -> bool:
        """Whether an unwrapped time is of a later boot than the last."""
        return boot_ms < self.last_boot_ms - REBOOT_MS

    def arrived(self, boot_ms: int, monotonic_ns: int) -> int:
        """When the message was made (monotonic ns), given when it arrived."""
        offset = monotonic_ns - boot_ms * 1_000_000
        while self._window and self._window[-1][1] >= offset:
            self._window.pop()
        self._window.append((monotonic_ns, offset))
        while self._window[0][0] < monotonic_ns - LATENCY_WINDOW_NS:
            self._window.popleft()
        self.last_boot_ms = boot_ms
        self._arrivals_ns.append(monotonic_ns)
        return boot_ms * 1_000_000 + self._window[0][1]

    def heard_hz(self, monotonic_ns: int) -> float:
        """Messages a second over the last RATE_WINDOW_NS."""
        since_ns = monotonic_ns - RATE_WINDOW_NS
        return sum(t > since_ns for t in self._arrivals_ns) / (RATE_WINDOW_NS * 1e-9)
