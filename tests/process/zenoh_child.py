"""Another process with a vehicle's session, for tests of what its end does."""

import json
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict

from companion.io.zenoh.configuration import SessionSettings

PROGRAM = """
import json, sys
from companion.io.zenoh.configuration import SessionSettings
from companion.io.zenoh.vehicle import ZenohTransport
plain = json.loads(sys.argv[1])
settings = SessionSettings(**{k: tuple(v) if isinstance(v, list) else v for k, v in plain.items()})
network = ZenohTransport(settings, lambda: None)
network.open()
network.publish("state", b"child")
print("open", flush=True)
"""
WAITS = "sys.stdin.read()\n"


@contextmanager
def child(settings: SessionSettings, then: str = WAITS) -> Iterator[subprocess.Popen[str]]:
    """It opens the session, says so and goes on with `then`."""
    process = subprocess.Popen(
        [sys.executable, "-c", PROGRAM + then, json.dumps(asdict(settings))],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    with process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == "open\n"
            yield process
        finally:
            process.kill()
