"""A PX4 SITL on this machine: where its parts are, which parameters it has, and what a simulated fleet sets on it.

Forks lie about their version: of which row of `px4_versions` a build is is told by the parameters that its binary has.
"""

import os
from collections.abc import Mapping
from functools import cache
from pathlib import Path

from companion.errors import CompanionError, ConfigError
from companion.vehicle.autopilot.px4_versions import NEWEST, VERSIONS, Px4Version, fleet_parameters

PLACES = (
    "/opt/px4", "build/px4_sitl_default", "PX4-Autopilot/build/px4_sitl_default",
    "~/PX4-Autopilot/build/px4_sitl_default",
)  # fmt: skip
"""where a PX4 is looked for that nobody names, after $PX4_BUILD: PX4's own package, a build beside, a build at home"""
HOW_TO_GET = (
    "Get PX4-Autopilot v1.16 or later from its project and run `make px4_sitl_default` "
    "(https://docs.px4.io/main/en/dev_setup/building_px4.html), or install PX4's own package, which lies in /opt/px4"
)
SITL_PARAMETERS: Mapping[str, float | int] = {"COM_RC_IN_MODE": 4, "NAV_DLL_ACT": 0}
"""of a simulated fleet, beside what every fleet sets: no stick input, no ground station"""


def find_build(given: Path | None) -> Path:
    """The folder that is given, or one of PLACES; CompanionError says what it needs to hold and how to get it."""
    named = os.environ.get("PX4_BUILD")
    said, build = (f"PX4_BUILD={named}", Path(named)) if given is None and named else (f"--px4 {given}", given)
    if build is not None:
        if not _is_build(build):
            raise ConfigError(f"{said}: is no PX4 build folder (needs bin/px4 and etc/). {HOW_TO_GET}")
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


def build_version(build: Path) -> Px4Version:
    """The newest row of PX4's versions whose parameters a build has; of none: the newest of all."""
    rows = [v for v in VERSIONS if has_parameter(build, v.sticks) and has_parameter(build, v.logging[0])]
    return rows[-1] if rows else NEWEST


def sitl_parameters(build: Path, *, logs: bool = False) -> dict[str, float | int]:
    """What is set on a build's instances; `logs`: they write their logs (25 MB a minute and vehicle)."""
    version = build_version(build)
    name, value = version.logging
    return {
        **fleet_parameters(version), **SITL_PARAMETERS, **version.sih_parameters, **({} if logs else {name: value}),
    }  # fmt: skip
