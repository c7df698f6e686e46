"""What a transport's threads put while the loop takes it."""

import sys
import threading
from collections.abc import Iterator

import pytest

from companion.io.inbox import Inbox
from companion.io.transport import Request

KINDS = ("state", "plan", "command", "preflight", "status")
ROUNDS = 1500


@pytest.fixture
def hurried() -> Iterator[None]:
    """Threads change at nearly every instruction."""
    before_s = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    yield
    sys.setswitchinterval(before_s)


@pytest.mark.usefixtures("hurried")
def test_the_first_of_each_kind_may_come_while_the_loop_looks_whether_anything_is_there() -> None:
    for _ in range(ROUNDS):
        inbox = Inbox(1, lambda: None)
        taken: list[object] = []

        def put(inbox: Inbox = inbox) -> None:
            for kind in KINDS[2:]:
                inbox.put_request(Request(kind, b"", lambda _: None, 0))
            for topic in KINDS[:2]:
                inbox.put_sample(f"fleet/2/{topic}", b"", 0)

        thread = threading.Thread(target=put)
        thread.start()
        while thread.is_alive():
            taken += inbox.drain()
        taken += inbox.drain()
        assert len(taken) == len(KINDS)
