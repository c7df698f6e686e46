"""A PX4 SITL on this machine: where its parts are, which parameters it has, and what a simulated fleet sets on it.

PX4's versions differ in their parameters, and forks lie about their version: what holds is told by the names that the
binary has.
"""

import os
from collections.abc import Mapping
from functools import cache
from pathlib import Path

from companion.errors import CompanionError

PLACES = (
    "/opt/px4", "build/px4_sitl_default", "PX4-Autopilot/build/px4_sitl_default",
    "~/PX4-Autopilot/build/px4_sitl_default",
)  # fmt: skip
"""where a PX4 is looked for that nobody names, after $PX4_BUILD: PX4's own package, a build beside, a build at home"""
HOW_TO_GET = (
    "Get PX4-Autopilot v1.16 or later from its project and run `make px4_sitl_default` "
    "(https://docs.px4.io/main/en/dev_setup/building_px4.html), or install PX4's own package, which lies in /opt/px4"
)
FLEET_PARAMETERS: Mapping[str, float | int] = {
    "COM_OBL_RC_ACT": 4,
    "COM_RC_OVERRIDE": 3,
    "MAN_OVERRIDE_SPD": 1.0,
    "COM_RC_IN_MODE": 4,
    "NAV_RCL_ACT": 0,
    "NAV_DLL_ACT": 0,
    "COM_RCL_EXCEPT": 4,
    "SDLOG_MODE": -1,
}
"""a fleet without RC: land when the setpoints end; no stick input; no log on disk. Of `px4_versions.RENAMED` a
version has one"""
NOISY_SENSORS: Mapping[str, float | int] = {"EKF2_ACC_NOISE": 0.6, "EKF2_GYR_NOISE": 0.1}
"""what SIH's sensors are like until v1.17: in flight their white noise is 0.5, 1.7 and 1.4 m/s^2 and 0.14, 0.07 and
0.03 rad/s a sample, of which the estimator's defaults (0.35 and 0.015) know nothing, so that it wanders by half a metre
(see docs/px4.md). Since v1.18 they are quiet, and these values make the estimate worse"""
SINCE_1_18 = "MAN_OVERRIDE_SPD"
"""a parameter that tells the two apart"""
LOG_BACKEND = "SDLOG_BACKEND"
"""where it is, SDLOG_MODE -1 stops no log: 25 MB a minute and vehicle"""


def find_build(given: Path | None) -> Path:
    """The folder that is given, or one of PLACES; CompanionError says what it needs to hold and how to get it."""
    named = os.environ.get("PX4_BUILD")
    said, build = (f"PX4_BUILD={named}", Path(named)) if given is None and named else (f"--px4 {given}", given)
    if build is not None:
        if not _is_build(build):
            raise CompanionError(f"{said}: is no PX4 build folder (needs bin/px4 and etc/). {HOW_TO_GET}")
        return build.resolve()
    places = [Path(place).expanduser() for place in PLACES]
    found = next((place for place in places if _is_build(place)), None)
    if found is None:
        looked = ", ".join(PLACES)
        raise CompanionError(
            f"--autopilot px4 needs --px4 BUILD_DIR: no PX4 is in PX4_BUILD, {looked}. {HOW_TO_GET}, and pass its "
            "folder, as build/px4_sitl_default"
        )
    return found.resolve()


def _is_build(folder: Path) -> bool:
    return (folder / "bin" / "px4").is_file() and (folder / "etc").is_dir()


@cache
def has_parameter(build: Path, name: str) -> bool:
    """Whether a build has a parameter of that name."""
    return b"\0" + name.encode() + b"\0" in (build / "bin" / "px4").read_bytes()


def simulator_parameters(build: Path) -> dict[str, float | int]:
    """What is set beside FLEET_PARAMETERS on a build's instances, by what that build is."""
    parameters: dict[str, float | int] = {} if has_parameter(build, SINCE_1_18) else dict(NOISY_SENSORS)
    if has_parameter(build, LOG_BACKEND):
        parameters[LOG_BACKEND] = 0
    return parameters
