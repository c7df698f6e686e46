"""What `fleet up` says to wrong words about PX4, without one."""

from pathlib import Path

import pytest
from fleet_process import run

from companion.core.frames import Geodetic
from companion.errors import CompanionError, ConfigError
from companion.vehicle.autopilot.px4_versions import NEWEST, VERSIONS, Px4Version
from sim.autopilot.parameters import defaults
from sim.launch.px4_build import build_version, find_build, sitl_parameters
from sim.launch.px4_instance import Px4Instance, parse_parameters

pytestmark = pytest.mark.process


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (("--autopilot", "px4"), "px4_sitl_default"),
        (("--autopilot", "px4", "--px4", "."), "is no PX4 build folder"),
        (("--autopilot", "px4", "--px4", "nowhere"), "px4_sitl_default"),
        (("--px4", "."), "needs --autopilot px4"),
        (("--parameter", "COM_OBL_RC_ACT=5"), "--autopilot px4"),
        (("--parameter", "nonsense"), "NAME=VALUE"),
        (("--autopilot", "ardupilot"), "stub, px4 or external"),
    ],
)
def test_wrong_words_are_refused_with_what_would_be_right(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...], why: str
) -> None:
    monkeypatch.setenv("PX4_BUILD", str(tmp_path / "none"))  # a machine may have one, which would fly
    done = run("sim", "up", "--out", str(tmp_path / "flights"), *words, folder=tmp_path)
    assert done.returncode != 0
    assert why in done.stderr
    assert not (tmp_path / "flights").exists()


def test_parameters_are_names_and_finite_numbers() -> None:
    assert parse_parameters(["COM_OBL_RC_ACT=5", "SIH_KDV=0.2"]) == {"COM_OBL_RC_ACT": 5, "SIH_KDV": 0.2}
    for wrong in ("COM_OBL_RC_ACT", "com=1", "A=", "A=nan", "A=inf", "=1", "A_NAME_LONGER_THAN_16=1", "A=1 2"):
        with pytest.raises(ConfigError, match="NAME=VALUE"):
            parse_parameters([wrong])


def a_build(folder: Path, *names: str) -> Path:
    """A folder that looks like a PX4 whose binary has parameters of these names."""
    (folder / "bin").mkdir(parents=True)
    (folder / "etc").mkdir()
    (folder / "bin" / "px4").write_bytes(b"\0".join([b"", *(n.encode() for n in names), b""]))
    return folder


def test_a_px4_is_found_where_it_is_named_and_where_it_usually_lies(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("PX4_BUILD", raising=False)
    monkeypatch.setattr("sim.launch.px4_build.PLACES", ("opt/px4", "build/px4_sitl_default"))
    with pytest.raises(CompanionError, match=r"no PX4 is in PX4_BUILD, opt/px4, build/px4_sitl_default\. Get PX4-Auto"):
        find_build(None)
    beside = a_build(tmp_path / "build" / "px4_sitl_default")
    assert find_build(None) == beside
    package = a_build(tmp_path / "opt" / "px4")
    assert find_build(None) == package
    named = a_build(tmp_path / "named")
    monkeypatch.setenv("PX4_BUILD", str(named))
    assert find_build(None) == named
    assert find_build(Path("opt/px4")) == package
    monkeypatch.setenv("PX4_BUILD", str(tmp_path / "nowhere"))
    with pytest.raises(CompanionError, match=r"PX4_BUILD=.*nowhere: is no PX4 build folder"):
        find_build(None)


@pytest.mark.parametrize("version", VERSIONS, ids=lambda v: v.name)
def test_of_which_version_a_build_is_follows_from_the_parameters_that_it_has(
    tmp_path: Path, version: Px4Version
) -> None:
    build = a_build(tmp_path / "build", *defaults(version))
    row = build_version(build)
    assert (row.sticks, row.logging) == (version.sticks, version.logging)
    assert sitl_parameters(build).keys() <= {*defaults(version), *version.sih_parameters}
    assert sitl_parameters(build)[version.logging[0]] == version.logging[1]
    assert version.logging[0] not in sitl_parameters(build, logs=True)
    assert ("EKF2_GYR_NOISE" in sitl_parameters(build)) == (version.name in ("1.16", "1.17")), "SIH's noisy sensors"


def test_of_a_build_that_tells_nothing_the_newest_is_taken(tmp_path: Path) -> None:
    assert build_version(a_build(tmp_path / "build")) is NEWEST


@pytest.mark.parametrize(
    ("says", "why"),
    [
        ("INFO [px4] PX4 server already running for instance 0", "another PX4 of instance 0 runs on this machine"),
        ("ERROR [param] no such thing", ""),
    ],
)
def test_a_px4_that_ends_at_its_start_is_told_with_its_last_lines(tmp_path: Path, says: str, why: str) -> None:
    build = a_build(tmp_path / "build")
    program = build / "bin" / "px4"
    program.write_text(f"#!/bin/sh\necho first\nprintf '\\033[31m{says}\\033[0m\\n'\nexit 3\n")
    program.chmod(0o755)
    instance = Px4Instance(0, Geodetic(47.4, 8.5, 488.0), build, tmp_path / "px4", {})
    instance.process.wait(10)
    words = instance.last_words()
    assert "ended at its start with status 3" in words
    assert ("another PX4" in words) == bool(why)
    assert why in words
    assert f"{tmp_path / 'px4' / 'px4.log'} says:\n    first\n    {says}" in words


@pytest.mark.parametrize("running", [True, False])
def test_a_socket_that_is_another_px4s_is_left_alone(tmp_path: Path, running: bool) -> None:
    build = a_build(tmp_path / "build")
    program = build / "bin" / "px4"
    program.write_text(f"#!/bin/sh\necho {'PX4 server already running for instance 249' if running else 'ended'}\n")
    program.chmod(0o755)
    socket_file = Path("/tmp/px4-sock-249")
    if socket_file.exists():
        pytest.skip("a PX4 of instance 249 runs here")
    instance = Px4Instance(249, Geodetic(47.4, 8.5, 488.0), build, tmp_path / "px4", {})
    instance.process.wait(10)
    socket_file.touch()
    try:
        instance.end()
        assert socket_file.exists() == running
    finally:
        socket_file.unlink(missing_ok=True)


def test_a_build_whose_commands_cannot_be_run_is_told_and_one_that_hangs_is_asked_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    build = a_build(tmp_path / "build")
    (build / "bin" / "px4").write_text("#!/bin/sh\nexit 0\n")
    (build / "bin" / "px4").chmod(0o755)
    instance = Px4Instance(249, Geodetic(47.4, 8.5, 488.0), build, tmp_path / "px4", {})
    instance.process.wait(10)
    assert not instance.open_state_link(1), "it has not started"
    with (tmp_path / "px4" / "px4.log").open("a") as log:
        log.write("INFO  [px4] Startup script returned successfully\n")
    with pytest.raises(CompanionError, match=r"px4-mavlink: cannot be run: .*is the PX4 build whole"):
        instance.open_state_link(1)
    (build / "bin" / "px4-mavlink").write_text("#!/bin/sh\nexec sleep 5\n")
    (build / "bin" / "px4-mavlink").chmod(0o755)
    monkeypatch.setattr("sim.launch.px4_instance.MAVLINK_TIMEOUT_S", 0.2)
    assert not instance.open_state_link(1)
