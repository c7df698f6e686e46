"""What `fleet up` says to wrong words about PX4, without one."""

from pathlib import Path

import pytest
from fleet_process import run

from companion.errors import ConfigError
from sim.launch.px4_instance import parse_parameters

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
def test_wrong_words_are_refused_with_what_would_be_right(tmp_path: Path, words: tuple[str, ...], why: str) -> None:
    done = run("sim", "up", "--out", str(tmp_path / "flights"), *words, folder=tmp_path)
    assert done.returncode != 0
    assert why in done.stderr
    assert not (tmp_path / "flights").exists()


def test_parameters_are_names_and_finite_numbers() -> None:
    assert parse_parameters(["COM_OBL_RC_ACT=5", "SIH_KDV=0.2"]) == {"COM_OBL_RC_ACT": 5, "SIH_KDV": 0.2}
    for wrong in ("COM_OBL_RC_ACT", "com=1", "A=", "A=nan", "A=inf", "=1", "A_NAME_LONGER_THAN_16=1", "A=1 2"):
        with pytest.raises(ConfigError, match="NAME=VALUE"):
            parse_parameters([wrong])
