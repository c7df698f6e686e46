"""Faults of a PX4 in SITL: what is sent for each, what ends it, what is refused; and the relay that cuts a link."""

import json
import socket
from typing import Any

import pytest

from companion.core.frames import Ned
from companion.errors import CompanionError
from companion.wire.px4 import Px4Mode
from sim.autopilot.faults import Fault, FaultKind, encode_order
from sim.launch.relay import LinkRelay
from sim.launch.sitl_faults import (
    BATTERY_UNIT,
    GPS_UNIT,
    OFF,
    STUCK,
    WORKING,
    WRONG,
    InstanceFaults,
    bytewise,
    kinds_of,
)

NEW = frozenset({"SIH_WIND_N", "SIH_WIND_E"})


class Px4:
    """One instance by hand."""

    system_id = 3

    def __init__(self) -> None:
        self.sent: list[Any] = []
        self.cut: list[bool] = []
        self.boots = 0
        self.relayed = True

    def send(self, message: Any) -> None:
        self.sent.append(message)

    def cut_link(self, cut: bool) -> None:
        if not self.relayed:
            raise CompanionError("its link is not relayed")
        self.cut.append(cut)

    def reboot(self) -> None:
        self.boots += 1


def of(px4: Px4, parameters: frozenset[str] = NEW) -> InstanceFaults:
    return InstanceFaults(3, px4, parameters.__contains__, (1.0, -2.0))


def order(
    faults: InstanceFaults, kind: FaultKind, duration_s: float = float("inf"), now_s: float = 0.0, **more: Any
) -> Any:
    return faults.carry_out(encode_order(3, Fault(kind, duration_s=duration_s, **more)), now_s)


def commands(px4: Px4) -> list[tuple[float, ...]]:
    return [(m.command, m.param1, m.param2) for m in px4.sent if m.get_type() == "COMMAND_LONG"]


def parameters(px4: Px4) -> list[tuple[str, float, int]]:
    return [(m.param_id, m.param_value, m.param_type) for m in px4.sent if m.get_type() == "PARAM_SET"]


@pytest.mark.parametrize(
    ("kind", "unit", "how"),
    [
        (FaultKind.GPS_LOST, GPS_UNIT, OFF),
        (FaultKind.GPS_STUCK, GPS_UNIT, STUCK),
        (FaultKind.GPS_WRONG, GPS_UNIT, WRONG),
        (FaultKind.LOW_BATTERY, BATTERY_UNIT, OFF),
    ],
)
def test_failures_are_injected_and_healed_in_their_time(kind: FaultKind, unit: int, how: int) -> None:
    px4 = Px4()
    faults = of(px4)
    assert order(faults, kind, 3.0, 10.0) is None
    faults.end_due(12.99)
    assert commands(px4) == [(420, unit, how)]
    faults.end_due(13.0)
    faults.end_due(20.0)
    assert commands(px4) == [(420, unit, how), (420, unit, WORKING)]


def test_a_wind_is_set_by_parameters_and_ends_as_it_was() -> None:
    px4 = Px4()
    faults = of(px4)
    assert order(faults, FaultKind.WIND, 5.0, wind_ned_m_s=Ned(3.0, -4.0, 0.0)) is None
    faults.end_due(5.0)
    assert parameters(px4) == [
        ("SIH_WIND_N", 3.0, 9),
        ("SIH_WIND_E", -4.0, 9),
        ("SIH_WIND_N", 1.0, 9),
        ("SIH_WIND_E", -2.0, 9),
    ]


def test_where_gps_cannot_be_injected_its_satellites_are_taken_away() -> None:
    px4 = Px4()
    faults = of(px4, frozenset())
    assert order(faults, FaultKind.GPS_LOST, 2.0) is None
    faults.end_due(2.0)
    assert parameters(px4) == [("SIM_GPS_USED", bytewise(0), 6), ("SIM_GPS_USED", bytewise(10), 6)]
    for kind in (FaultKind.WIND, FaultKind.GPS_STUCK, FaultKind.GPS_WRONG):
        why = order(faults, kind)
        assert why is not None
        assert why.startswith("this PX4 suffers gps_lost, link_lost, low_battery, pilot_takeover, reboot, got ")


def test_a_pilot_takes_over_by_a_mode_and_a_boot_ends_what_lasts() -> None:
    px4 = Px4()
    faults = of(px4)
    assert order(faults, FaultKind.PILOT_TAKEOVER) is None
    (message,) = px4.sent
    assert (message.command, message.param2, message.param3) == (176, 4, 3)
    assert int(message.param2) << 16 | int(message.param3) << 24 == Px4Mode.AUTO_LOITER
    assert order(faults, FaultKind.GPS_LOST, 3.0) is None
    assert order(faults, FaultKind.REBOOT) is None
    faults.forget()
    faults.end_due(100.0)
    assert px4.boots == 1
    assert len(px4.sent) == 2


def test_a_link_is_cut_and_joined_and_one_that_nobody_relays_is_refused_with_the_cure() -> None:
    px4 = Px4()
    faults = of(px4)
    assert order(faults, FaultKind.LINK_LOST, 1.0) is None
    assert order(faults, FaultKind.LINK_LOST, 0.0, 0.5) is None
    faults.end_due(2.0)
    assert px4.cut == [True, False]
    px4.relayed = False
    assert order(faults, FaultKind.LINK_LOST) == "its link is not relayed"


@pytest.mark.parametrize(
    ("sent", "why"),
    [
        (encode_order(4, Fault(FaultKind.GPS_LOST)), "this is vehicle 3, not 4"),
        (b"nonsense", "Expecting value"),
        (json.dumps({"vehicle": 3, "kind": "wind", "wind_ned_m_s": [0, 0, 1]}).encode(), "must be level"),
        (json.dumps({"vehicle": 3, "kind": "wind", "wind_ned_m_s": [31, 0, 0]}).encode(), "at most 30 m/s"),
        (json.dumps({"vehicle": 3, "kind": "rc_kill"}).encode(), "this PX4 suffers"),
    ],
)
def test_an_order_that_cannot_be_carried_out_says_why_and_changes_nothing(sent: bytes, why: str) -> None:
    px4 = Px4()
    answer = of(px4).carry_out(sent, 0.0)
    assert answer is not None
    assert why in answer
    assert px4.sent == []


def test_what_a_build_can_suffer_follows_from_its_parameters() -> None:
    assert FaultKind.WIND in kinds_of(NEW.__contains__)
    assert {FaultKind.WIND, FaultKind.GPS_STUCK, FaultKind.GPS_WRONG}.isdisjoint(kinds_of(frozenset().__contains__))


def bound() -> socket.socket:
    s = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    s.bind(("127.0.0.1", 0))
    s.settimeout(5.0)
    return s


def test_a_relay_passes_all_both_ways_and_nothing_while_it_is_cut() -> None:
    with bound() as px4, bound() as companion:
        relay = LinkRelay(px4.getsockname()[1], companion.getsockname()[1])
        try:
            px4.sendto(b"position", ("127.0.0.1", relay.port))
            relay.serve(relay.px4)
            datagram, where = companion.recvfrom(100)
            assert datagram == b"position"
            companion.sendto(b"setpoint", where)
            relay.serve(relay.companion)
            assert px4.recv(100) == b"setpoint"
            relay.cut = True
            for end, sender, to in ((relay.px4, px4, ("127.0.0.1", relay.port)), (relay.companion, companion, where)):
                sender.sendto(b"lost", to)
                relay.serve(end)
            relay.cut = False
            px4.sendto(b"again", ("127.0.0.1", relay.port))
            relay.serve(relay.px4)
            assert companion.recv(100) == b"again"
        finally:
            relay.close()
