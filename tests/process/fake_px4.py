"""A build folder whose `bin/px4` is a stub with a ground station's link: PX4's place in tests of its launcher."""

import os
import select
import socket
import sys
import threading
from pathlib import Path

from companion.core.frames import Geodetic, Ned
from companion.vehicle.autopilot.px4_versions import OLDEST, version_named
from sim.autopilot.parameters import defaults
from sim.autopilot.stubs import StubFleetSettings, StubVehicleSettings, run_stubs
from sim.launch.px4_instance import STARTED, STATE_PORT

ROOT = Path(__file__).resolve().parents[2]
HERE = Path(__file__).resolve().parent
GROUND_PORT, GROUND_PORT_OF_INSTANCE = 14550, 18570
LINK = b"link to "


def fake_build(folder: Path, version: str = OLDEST.name) -> Path:
    """A folder that passes for the build/px4_sitl_default of a version, by the names of parameters in its program."""
    names = "".join(f"\0{name}\0" for name in defaults(version_named(version)))
    (folder / "bin").mkdir(parents=True)
    (folder / "etc").mkdir()
    for name, function in (("px4", "main"), ("px4-mavlink", "open_link")):
        program = folder / "bin" / name
        script = f"import sys; sys.path[:0] = ['{ROOT}', '{HERE}']; import fake_px4; fake_px4.{function}('{version}')"
        program.write_text(f'#!/bin/sh\nexec {sys.executable} -c "{script}" "$@"\n{names}')
        program.chmod(0o755)
    return folder


def open_link(_: str) -> None:
    """`px4-mavlink --instance N start ... -u OWN ... -o PORT`."""
    own, port = (sys.argv[sys.argv.index(word) + 1] for word in ("-u", "-o"))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as s:
        s.sendto(LINK + port.encode(), ("127.0.0.1", int(own)))


def _relay(index: int) -> None:
    """The stub's link to a ground station, as one on a port of its own to whoever asked for it last."""
    link, ground = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
    link.bind(("127.0.0.1", STATE_PORT + index))
    ground.bind(("127.0.0.1", GROUND_PORT))
    port: int | None = None
    while True:
        ready, _, _ = select.select([link, ground], [], [])
        if link in ready:
            datagram = link.recv(2048)
            if datagram.startswith(LINK):
                port = int(datagram.removeprefix(LINK))
            else:
                ground.sendto(datagram, ("127.0.0.1", GROUND_PORT_OF_INSTANCE + index))
        if ground in ready:
            datagram = ground.recv(2048)
            if port is not None:
                link.sendto(datagram, ("127.0.0.1", port))


def main(version: str) -> None:
    """`px4 -i N -d ETC -w FOLDER`, with PX4_HOME_* and PX4_PARAM_*; parameters that there are not are passed over."""
    index = int(sys.argv[sys.argv.index("-i") + 1])
    home = Geodetic(*(float(os.environ[f"PX4_HOME_{name}"]) for name in ("LAT", "LON", "ALT")))
    known = defaults(version_named(version))
    given = {name.removeprefix("PX4_PARAM_"): value for name, value in os.environ.items()}
    parameters = {name: type(known[name])(given[name]) for name in known if name in given}
    vehicle = StubVehicleSettings(
        index + 1, index + 1, 14580 + index, 14540 + index, Ned(0.0, 0.0, 0.0), instance=index,
        parameters=tuple(parameters.items()), px4=version,
    )  # fmt: skip
    threading.Thread(target=_relay, args=(index,), daemon=True).start()
    print(STARTED, flush=True)  # noqa: T201 (as PX4 does)
    run_stubs(StubFleetSettings((vehicle,), home, ground=True))
