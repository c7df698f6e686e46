"""What a Zenoh session is given; nobody writes Zenoh's own configuration by hand.

All keys are below a namespace, the fleet's name: fleets of different names on one network do not hear each other.
Sessions are peers, also the operator's: peers do not relay, so a client would hear the one vehicle that it is connected
to.

Of each pair one end connects: in the field the vehicle with the larger id, an operator to all; on a laptop both find
each other by scouting, and the second connection is refused. That connection is TCP and carries all, states too:
they come in order behind whatever segment is repeated. UDP alone loses declarations, which nobody repeats, and its pair
stays deaf; a UDP link beside TCP is the same after a stall as long as the lease, for one end then joins the other's old
transport (docs/results/packets.md).

A session sends a keep-alive to a peer only if it has sent it nothing else for the lease's share, so every message takes
a keep-alive's place.
"""

from __future__ import annotations

import ipaddress
import json
import re
import zlib
from dataclasses import dataclass
from typing import Any, Final, Literal, assert_never

import zenoh

from companion.config import FleetConfig
from companion.config.bounds import KEEP_ALIVES, notice_lost_s
from companion.errors import ConfigError
from companion.io.transport import PAYLOAD_MAX_BYTES, PLAN_TOPIC, REQUEST_KINDS, STATE_TOPIC, VEHICLE_ID_MAX

STATE_MAX_BYTES: Final = 16_384
"""above the largest state with a digest of 255 entries"""
QUESTION_MAX_BYTES: Final = 1024
"""of a question that is no command"""
PLANS_HZ: Final = 20.0
"""how often a session hears a plan from one other session at most; the rest is left out before Python sees it. Not so
for states: of what a stalled link delivers at once the oldest alone would be heard, and nobody repeats a state soon"""
REQUESTS_HZ: Final = 50.0
"""the same for each kind of question"""
MESSAGE_MAX_BYTES: Final = 1 << 20
"""what a session reassembles from fragments at most"""

_SCOUTING_ADDRESS: Final = "224.0.0.224"
_SCOUTING_PORTS: Final = range(20_000, 24_000)
"""below Linux' ephemeral ports and clear of MAVLink's: 14540-14789, 18570-18819, 24540-25049, 25540-25789"""
_RETRY: Final = {"period_init_ms": 200, "period_max_ms": 1000, "period_increase_factor": 1.5}
_FLEET_NAME: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}")


@dataclass(frozen=True, slots=True)
class SessionSettings:
    """What a session needs to know; `zenoh_configuration` turns it into Zenoh's own configuration."""

    fleet_name: str
    """Zenoh namespace: fleets of different names on one network do not hear each other"""
    vehicle_id: int | None
    """1..250; None for an operator's client"""
    profile: Literal["laptop", "field"] = "laptop"
    listen: tuple[str, ...] = ()
    """Zenoh endpoints, `tcp/127.0.0.1:7450`; on a laptop they switch scouting off, in the field they are required"""
    connect: tuple[str, ...] = ()
    """Zenoh endpoints of the others; all of them: peers do not relay"""
    scouting_port: int | None = None
    """UDP port of the laptop's scouting; None: derived from the fleet's name"""
    notice_lost_s: float | None = None
    """within this time the end of a session is noticed whose computer or radio is gone: the lease; None: the profile's
    default"""

    def __post_init__(self) -> None:
        if not _FLEET_NAME.fullmatch(self.fleet_name):
            raise ConfigError(
                "fleet name must be 1..64 of A-Z a-z 0-9 _ . - beginning with a letter or digit,"
                f" got {self.fleet_name!r}"
            )
        if self.vehicle_id is not None and not 1 <= self.vehicle_id <= VEHICLE_ID_MAX:
            raise ConfigError(f"vehicle id must be in 1..{VEHICLE_ID_MAX}, got {self.vehicle_id}")
        if self.scouting_port is not None and not 1024 <= self.scouting_port <= 65_535:
            raise ConfigError(f"scouting port must be in 1024..65535, got {self.scouting_port}")
        match self.profile:
            case "laptop":
                for endpoint in (*self.listen, *self.connect):
                    if not _is_loopback(endpoint):
                        raise ConfigError(
                            f"a laptop's endpoints must be on loopback, got {endpoint!r}; or use profile field"
                        )
            case "field":
                if not self.connect and not self.listen:
                    raise ConfigError("profile field needs endpoints to listen on or to connect to, got none")
                if self.vehicle_id is not None and not self.listen:
                    raise ConfigError("profile field needs the endpoints a vehicle listens on, got none")
            case _:
                assert_never(self.profile)


def session_settings(config: FleetConfig, vehicle_id: int | None) -> SessionSettings:
    """The session of a vehicle, or of an operator (None)."""
    own = None if vehicle_id is None else config.by_id(vehicle_id).zenoh
    others = [v.zenoh for v in config.vehicles if vehicle_id is None or v.id < vehicle_id]
    return SessionSettings(
        fleet_name=config.fleet.name,
        vehicle_id=vehicle_id,
        profile=config.peers.network,
        listen=() if own is None else (own,),
        connect=tuple(endpoint for endpoint in others if endpoint is not None),
        scouting_port=config.peers.scouting_port,
        notice_lost_s=config.peers.notice_lost_s,
    )


def scouting_port(fleet_name: str) -> int:
    """The UDP port on which a fleet of this name scouts; stable across machines and versions."""
    return _SCOUTING_PORTS[zlib.crc32(fleet_name.encode()) % len(_SCOUTING_PORTS)]


def zenoh_configuration(settings: SessionSettings) -> zenoh.Config:
    """Zenoh's configuration for these settings."""
    match settings.profile:
        case "laptop":
            specific = _laptop(settings)
        case "field":
            specific = _field(settings)
        case _:
            assert_never(settings.profile)
    tree = {"mode": "peer", "namespace": settings.fleet_name, "timestamping": {"enabled": True}, **specific}
    tree["transport"]["shared_memory"] = {"enabled": False}
    lease_s = notice_lost_s(settings.profile, settings.notice_lost_s)
    link = tree["transport"].setdefault("link", {})
    link["rx"] = {"max_message_size": MESSAGE_MAX_BYTES}
    link["tx"] = {"lease": round(1e3 * lease_s), "keep_alive": KEEP_ALIVES[settings.profile]}
    # An express message fills a whole batch, and of the default's two batches a link the third message within a
    # millisecond is dropped when the machine is busy. Smaller batches keep the memory of thirty links small.
    link["tx"] |= {"batch_size": 8192, "queue": {"size": {"real_time": 16, "interactive_high": 16}}}
    if settings.vehicle_id is not None:
        tree |= _flood_limits(settings.fleet_name, settings.vehicle_id)
    return zenoh.Config.from_json5(json.dumps(tree))


def _flood_limits(fleet_name: str, vehicle_id: int) -> dict[str, Any]:
    """What Zenoh leaves out of what comes in, for each session that is connected.

    It does so in the receiving thread, without the interpreter's lock. These keys have the namespace in front; rules
    with any others do nothing, and nobody says so.
    """

    def topic(name: str) -> str:
        return f"{fleet_name}/fleet/*/{name}"

    def question(kind: str) -> str:
        return f"{fleet_name}/fleet/{vehicle_id}/{kind}"

    puts = [{"key_expr": topic(PLAN_TOPIC), "freq": PLANS_HZ}]
    queries = [{"key_expr": question(kind), "freq": REQUESTS_HZ} for kind in REQUEST_KINDS]
    sizes = [
        ("state", ["put", "reply"], [topic(STATE_TOPIC)], STATE_MAX_BYTES),
        ("plan", ["put", "reply"], [topic(PLAN_TOPIC)], PAYLOAD_MAX_BYTES),
        ("command", ["query"], [question("command")], PAYLOAD_MAX_BYTES),
        ("question", ["query"], [question("status"), question("preflight")], QUESTION_MAX_BYTES),
    ]
    return {
        "downsampling": [
            {"id": name, "messages": messages, "flows": ["ingress"], "rules": rules}
            for name, messages, rules in (("puts", ["put", "delete"], puts), ("queries", ["query"], queries))
        ],
        "low_pass_filter": [
            {"id": name, "messages": messages, "flows": ["ingress"], "key_exprs": keys, "size_limit": size}
            for name, messages, keys, size in sizes
        ],
    }


def _laptop(settings: SessionSettings) -> dict[str, Any]:
    explicit = bool(settings.listen or settings.connect)
    multicast: dict[str, Any] = {"enabled": False}
    if not explicit:
        port = scouting_port(settings.fleet_name) if settings.scouting_port is None else settings.scouting_port
        # "greater-zid" would leave every second late joiner unconnected until the others' next scouting round, up to
        # eight seconds; with "always" both sides try and one of the two links is refused.
        multicast = {
            "enabled": True,
            "address": f"{_SCOUTING_ADDRESS}:{port}",
            "interface": "lo",
            "ttl": 0,
            "autoconnect": {"peer": ["router", "peer"]},
            "autoconnect_strategy": {"peer": "always"},
        }
    return {
        "listen": {"endpoints": list(settings.listen) or ["tcp/127.0.0.1:0"]},
        "connect": _connect(settings),
        "scouting": {"multicast": multicast, "gossip": {"enabled": False}},
        "transport": {},
    }


def _field(settings: SessionSettings) -> dict[str, Any]:
    return {
        "listen": {"endpoints": list(settings.listen)},
        "connect": _connect(settings),
        # Who hears by gossip of a session connects to it as well: a second connection of the pair.
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "transport": {"unicast": {"max_links": 1, "open_timeout": 1000, "accept_timeout": 1000}},
    }


def _connect(settings: SessionSettings) -> dict[str, Any]:
    return {"endpoints": list(settings.connect), "timeout_ms": -1, "exit_on_failure": False, "retry": _RETRY}


def _is_loopback(endpoint: str) -> bool:
    """Whether a Zenoh endpoint `protocol/host:port?metadata` stays on this machine."""
    protocol, _, rest = endpoint.partition("/")
    if protocol.startswith("unix"):
        return True
    host = re.split(r"[?#]", rest, maxsplit=1)[0].rpartition(":")[0].strip("[]")
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
