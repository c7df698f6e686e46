"""One PX4 SITL process (SIH quadrotor, headless): how it is built, parametrised, started and ended."""

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from math import isfinite
from pathlib import Path

from companion.config.endpoints import autopilot_port
from companion.core.frames import Geodetic
from companion.errors import CompanionError, ConfigError
from companion.terminal import one_line

END_TIMEOUT_S = 6.0
MAVLINK_TIMEOUT_S = 10.0
SIH_QUADROTOR = 10040
STATE_PORT = 24800
"""from which instance i tells its state: this plus i"""
OFFBOARD_PORT = 14580
"""from which PX4's scripts have instance i speak to its companion: this plus i"""
LAST_LINES = 5
STARTED = "Startup script returned"
"""what PX4 says once all its modules run"""
STARTED_WITHIN_S = 10.0
"""then it is tried whatever was said"""
RUNNING = "already running for instance"
"""what PX4 says where its lock is taken"""


def parse_parameters(texts: Sequence[str]) -> dict[str, float | int]:
    """PX4 parameters from the command line, NAME=VALUE each."""
    parameters: dict[str, float | int] = {}
    for text in texts:
        name, _, value = text.partition("=")
        try:
            if not re.fullmatch("[A-Z][A-Z0-9_]{0,15}", name):
                raise ValueError(name)
            number = float(value)
            if not isfinite(number):
                raise ValueError(value)
        except ValueError:
            raise ConfigError(f"--parameter must be NAME=VALUE, a PX4 parameter and a number, got {text!r}") from None
        parameters[name] = int(number) if number.is_integer() else number
    return parameters


class Px4Instance:
    """One running PX4 process. Instance i has system id i + 1 and links as PX4's scripts open them.

    It gets SIGTERM when whoever started it dies, however that may be.
    """

    def __init__(self, index: int, home: Geodetic, build: Path, folder: Path, parameters: Mapping[str, float | int]):
        folder = folder.resolve()  # PX4 changes its folder before it reads this
        folder.mkdir(parents=True)
        environment = {
            **{k: v for k, v in os.environ.items() if not k.startswith("PX4_")},
            "PX4_SIM_MODEL": "sihsim_quadx",
            "PX4_SYS_AUTOSTART": str(SIH_QUADROTOR),
            "PX4_HOME_LAT": f"{home.latitude_deg:.9f}",
            "PX4_HOME_LON": f"{home.longitude_deg:.9f}",
            "PX4_HOME_ALT": f"{home.altitude_amsl_m:.3f}",
            **{f"PX4_PARAM_{name}": str(value) for name, value in parameters.items()},
        }
        self.index = index
        self.system_id = index + 1
        self.parameters = parameters
        self.build = build
        self.state_link = False
        """whether its state comes over a link of its own"""
        self._log = folder / "px4.log"
        self._begun_s = time.monotonic()
        with self._log.open("wb") as log:
            self.process = subprocess.Popen(
                [sys.executable, "-I", "-S", "-c", _END_WITH_PARENT, str(build / "bin" / "px4"), "-i", str(index),
                 "-d", str(build / "etc"), "-w", str(folder)],
                cwd=folder, env=environment, stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT,
                start_new_session=True,
            )  # fmt: skip

    def open_state_link(self, port: int) -> bool:
        """A link that tells arming and mode to that port, so that 14550 is left to a ground station.

        Whether it is open: not before the instance has started. PX4 takes the command before that too, but a link that
        is older than the simulation's clock falls silent when that is set.
        """
        started = STARTED in self._said or time.monotonic() - self._begun_s > STARTED_WITHIN_S
        if not self.state_link and started:
            own, speed = str(STATE_PORT + self.index), ("-r", "4000000", "-f")
            self.state_link = self._mavlink("start", "-x", "-u", own, *speed, "-o", str(port)).returncode == 0
        return self.state_link

    def open_offboard_link(self, to_port: int) -> None:
        """A link to that port, in place of the one that PX4's scripts have opened; on the ground only.

        Past ten instances those send to one port for all. PX4 has room for six links, so that the old one goes first.
        """
        self._mavlink("stop", "-u", str(OFFBOARD_PORT + self.index))
        own, speed = str(autopilot_port(self.index)), ("-r", "4000000", "-f", "-m", "onboard")
        done = self._mavlink("start", "-x", "-u", own, *speed, "-o", str(to_port))
        if done.returncode != 0:
            said = f"{done.stdout}{done.stderr}".strip()
            raise CompanionError(f"PX4 instance {self.index} opens no link on {own}: {said}")

    def _mavlink(self, *command: str) -> subprocess.CompletedProcess[str]:
        words = [str(self.build / "bin" / "px4-mavlink"), "--instance", str(self.index), *command]
        try:
            return subprocess.run(words, check=False, capture_output=True, text=True, timeout=MAVLINK_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            return subprocess.CompletedProcess(words, 1, "", f"no answer within {MAVLINK_TIMEOUT_S:g} s")
        except OSError as error:
            raise CompanionError(f"{words[0]}: cannot be run: {error.strerror} (is the PX4 build whole?)") from error

    @property
    def _said(self) -> str:
        return self._log.read_text(encoding="utf-8", errors="replace")

    def last_words(self) -> str:
        """What to say of a process that has ended at its start."""
        text = self._said
        lines = [one_line(re.sub(r"\x1b\[[0-9;]*m", "", line)) for line in text.splitlines() if line.strip()]
        said = "".join(f"\n    {line}" for line in lines[-LAST_LINES:]) or " nothing"
        why = ""
        if RUNNING in text:
            why = (
                f": another PX4 of instance {self.index} runs on this machine, or ended without taking its lock away "
                "(px4_lock and px4-sock in the folder of TMPDIR, or /tmp): end it, or remove them"
            )
        return f"PX4 ended at its start with status {self.process.poll()}{why}. The end of {self._log} says:{said}"

    def ask_to_end(self) -> None:
        """SIGTERM, from which PX4 ends in about two seconds."""
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        """End it at once, as if its computer had lost power."""
        self.process.kill()
        self.end()

    def end(self) -> None:
        """End it, with SIGKILL if need be, and wait until it is gone."""
        self.ask_to_end()
        try:
            self.process.wait(END_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        if RUNNING not in self._said:  # else it is another one's
            Path(f"/tmp/px4-sock-{self.index}").unlink(missing_ok=True)


_END_WITH_PARENT = f"""
import ctypes, os, sys
ctypes.CDLL(None).prctl(1, {int(signal.SIGTERM)})
os.execv(sys.argv[1], sys.argv[1:])
"""
"""PR_SET_PDEATHSIG lasts through exec; set in an interpreter of its own, since forking a process with threads to run
Python in it may hang"""
