"""What a companion's TCP connections have sent, as the kernel counts it; and what follows from it."""

import socket
from contextlib import ExitStack

import pytest

from companion.io.zenoh.traffic import ETHERNET_IP_TCP_BYTES, TcpTraffic
from sim.launch.summary.summarise import packets_reduction_percent


def pair(opened: ExitStack) -> tuple[socket.socket, socket.socket]:
    """Both ends of a connection on the loopback interface."""
    listener = opened.enter_context(socket.create_server(("127.0.0.1", 0)))
    one = opened.enter_context(socket.create_connection(listener.getsockname()))
    other, _ = listener.accept()
    return one, opened.enter_context(other)


def test_what_is_sent_is_counted_with_its_headers_and_kept_when_the_connection_ends() -> None:
    traffic = TcpTraffic()
    with ExitStack() as opened:
        before = traffic.sent()
        one, other = pair(opened)
        one.sendall(bytes(1000))
        assert len(other.recv(1000, socket.MSG_WAITALL)) == 1000
        sent = traffic.sent()
        packets, octets = sent.packets - before.packets, sent.bytes - before.bytes
        assert packets >= 3  # both handshakes and the bytes
        # Acknowledgements add headers alone, and are sent when the kernel likes.
        assert (octets - 1000) % ETHERNET_IP_TCP_BYTES in (0, 1, 2)  # each end's SYN counts as a byte in some kernels
    after = traffic.sent()
    assert after.packets >= sent.packets
    assert after.bytes >= sent.bytes


def test_datagrams_are_not_counted() -> None:
    traffic = TcpTraffic()
    before = traffic.sent()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as one:
        one.sendto(b"x", ("127.0.0.1", 9))
        assert traffic.sent() == before


@pytest.mark.parametrize(
    ("packets_hz", "vehicles", "fewer"),
    [(None, 10, None), (0.0, 1, None), (18.0, 10, 90.0), (180.0, 10, 0.0), (360.0, 10, -100.0)],
)
def test_the_saving_is_against_one_packet_to_each_peer_twenty_times_a_second(
    packets_hz: float | None, vehicles: int, fewer: float | None
) -> None:
    assert packets_reduction_percent(packets_hz, vehicles) == fewer
