"""Which transport carries the fleet's traffic: the one place that chooses an adapter.

Adapters are imported when they are asked for: a command that opens no network does not pay for them.
"""

from collections.abc import Callable

from companion.config import FleetConfig
from companion.io.transport import OperatorLink, PeerTransport


def peer_transport(config: FleetConfig, vehicle_id: int, wake: Callable[[], None]) -> PeerTransport:
    """A vehicle's end of the fleet's network, not open yet."""
    from companion.io.zenoh.configuration import session_settings
    from companion.io.zenoh.vehicle import ZenohTransport

    return ZenohTransport(session_settings(config, vehicle_id), wake)


def operator_link(config: FleetConfig) -> OperatorLink:
    """An operator's end of the fleet's network, not open yet."""
    from companion.io.zenoh.configuration import session_settings
    from companion.io.zenoh.operator import ZenohOperatorLink

    return ZenohOperatorLink(session_settings(config, None))
