"""The campaign on real PX4, as far as it needs none: what a version draws, what is ordered, what of truth is judged."""

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from companion.core.values import Phase
from companion.errors import ConfigError
from companion.wire.mavlink import ON_GROUND
from companion.wire.px4 import Px4Mode
from sim.autopilot.faults import Fault, FaultKind
from sim.autopilot.stubs import TRUTH_DTYPE
from sim.launch.faults import CompanionFault, CompanionFaultKind
from sim.study.campaign_faults import EXPLAINED, Drawn, Flight, drawn_faults
from sim.study.campaign_judge import judged, tables_of
from sim.study.campaign_px4 import KINDS, STALLED_MOST_S, flight_of, scheduled, seen_of, settled, with_build
from sim.study.common import Config, load_config

SECOND_NS = 1_000_000_000
Row = tuple[float, float, int, int]
"""s, north (m), landed state, mode"""
T0 = 1_790_000_000 * SECOND_NS


def a_build(folder: Path, *names: str) -> Path:
    (folder / "bin").mkdir(parents=True)
    (folder / "etc").mkdir()
    (folder / "bin" / "px4").write_bytes(b"\0".join([b"", *(n.encode() for n in names), b""]))
    return folder


def test_every_kind_is_explained_and_ordered() -> None:
    assert set(KINDS) <= set(EXPLAINED)
    for kind in KINDS:
        ordered = scheduled(Drawn(4.0, 2, kind, 10.0), 7)
        assert (ordered.at_s, ordered.vehicle_id) == (4.0, 2)
        assert isinstance(ordered.fault, Fault | CompanionFault)
    stopped = scheduled(Drawn(4.0, 2, "stalled", 1000.0), 7).fault
    assert stopped == CompanionFault(CompanionFaultKind.STOPPED, STALLED_MOST_S)
    wind = scheduled(Drawn(4.0, 2, "wind", 10.0), 7).fault
    assert isinstance(wind, Fault)
    assert wind.kind is FaultKind.WIND
    assert wind.wind_ned_m_s != (0.0, 0.0, 0.0)
    assert wind == scheduled(Drawn(4.0, 2, "wind", 10.0), 7).fault, "a seed's wind is the same each time"


def test_a_version_draws_what_it_can_suffer(tmp_path: Path) -> None:
    config = load_config("campaign_px4")
    old = flight_of(config, a_build(tmp_path / "old", "COM_RC_OVERRIDE", "SDLOG_MODE"))
    new = flight_of(config, a_build(tmp_path / "new", "SIH_WIND_N", "MAN_OVERRIDE_SPD"))
    assert set(new.kinds) == set(KINDS)
    assert set(KINDS) - set(old.kinds) == {"wind", "gps_stuck", "gps_wrong"}
    assert {f.kind for seed in range(200) for f in drawn_faults(old, seed)} == set(old.kinds)
    wrong = Config(config.name, config.text, {"flight": {**config.values["flight"], "kinds": ["eclipse"]}})
    with pytest.raises(ConfigError, match="there is no eclipse; known are gps_lost, "):
        flight_of(wrong, tmp_path / "new")


def test_flights_of_another_build_are_none_of_this_one(tmp_path: Path) -> None:
    config = load_config("campaign_px4")
    one = with_build(config, a_build(tmp_path / "one", "SIH_WIND_N"))
    other = with_build(config, a_build(tmp_path / "two", "SIH_WIND_E"))
    assert one.text != other.text
    assert one.values["px4"]["build"] == str(tmp_path / "one")


def truth(tracks: dict[int, list[Row]]) -> npt.NDArray[Any]:
    """(s, north, landed state, mode) of each vehicle, 3 m up."""
    rows = []
    for i, track in tracks.items():
        for s, north, landed, mode in track:
            row = np.zeros((), TRUTH_DTYPE)
            row["time_unix_ns"], row["vehicle_id"] = T0 + round(s * 1e9), i
            row["position_ned_m"], row["landed_state"], row["custom_mode"] = (north, 0.0, -3.0), landed, mode
            rows.append(row)
    return np.array(rows, TRUTH_DTYPE)


def line(begin: float, end: float, seconds: float = 10.0, gap: tuple[float, float] = (99.0, 99.0)) -> list[Row]:
    return [
        (s, begin + (end - begin) * s / seconds, 2, int(Px4Mode.OFFBOARD))
        for s in np.arange(0.0, seconds, 0.02)
        if not gap[0] < s < gap[1]
    ]


def the_flight(tmp_path: Path) -> Flight:
    return flight_of(load_config("campaign_px4"), a_build(tmp_path / "b", "SIH_WIND_N"))


def test_two_that_meet_are_found_and_excused_where_one_of_them_is_blind(tmp_path: Path) -> None:
    flight = the_flight(tmp_path)
    seen = seen_of(truth({1: line(0.0, 8.0), 2: line(8.0, 0.0)}), [1, 2], [], T0)
    record = judged(seen, [], flight)
    assert record["minimum_distance_m"] < 0.05
    assert record["minimum_of"][1:] == [1, 2]
    blind = judged(seen, [Drawn(1.0, 2, "gps_stuck", 10.0)], flight)
    assert blind["minimum_distance_m"] > 5.0
    assert blind["minimum_with_the_blind_m"] < 0.05


def test_where_nobody_tells_nothing_is_judged_and_nothing_invented(tmp_path: Path) -> None:
    """A PX4 that is started anew tells nothing meanwhile: no line is drawn from where it was to its pad."""
    flight = the_flight(tmp_path)
    seen = seen_of(truth({1: line(0.0, 8.0, gap=(3.0, 7.0)), 2: line(8.0, 0.0)}), [1, 2], [], T0)
    gone = np.isnan(seen.rows["position_ned_m"][:, 0, 0])
    assert gone[(seen.seconds > 3.1) & (seen.seconds < 6.9)].all()
    assert not gone[(seen.seconds < 2.9) | (seen.seconds > 7.1)].any()
    assert judged(seen, [], flight)["minimum_distance_m"] > 1.5


def test_the_fence_is_for_whoever_flies_on_setpoints(tmp_path: Path) -> None:
    flight = the_flight(tmp_path)
    far = flight.fence_radius_m + 5.0
    out = truth({1: line(0.0, far), 2: line(8.0, 8.0)})
    assert judged(seen_of(out, [1, 2], [], T0), [], flight)["beyond_fence_m"] == pytest.approx(5.0, abs=0.2)
    out["custom_mode"][out["vehicle_id"] == 1] = int(Px4Mode.AUTO_LAND)
    assert judged(seen_of(out, [1, 2], [], T0), [], flight)["beyond_fence_m"] < 0.0
    out["custom_mode"], out["landed_state"] = int(Px4Mode.OFFBOARD), ON_GROUND
    assert judged(seen_of(out, [1, 2], [], T0), [], flight)["beyond_fence_m"] < 0.0


LANDING, ALOFT = 4, 2


@pytest.mark.parametrize(
    ("armed", "landed", "mode", "down_m", "speed_m_s", "phase", "over"),
    [
        (0, ON_GROUND, Px4Mode.AUTO_LAND, 0.0, 0.0, Phase.LANDED, True),
        (0, ON_GROUND, Px4Mode.OFFBOARD, 0.0, 0.0, None, True),
        (1, ALOFT, Px4Mode.OFFBOARD, -3.0, 1.0, Phase.MOVING, False),
        (1, ALOFT, Px4Mode.AUTO_LOITER, -3.0, 0.0, Phase.MOVING, False),
        (1, ALOFT, Px4Mode.AUTO_LOITER, -3.0, 0.0, Phase.RELEASED, True),
        (1, ALOFT, Px4Mode.AUTO_LOITER, -3.0, 0.0, None, True),
        (1, ALOFT, Px4Mode.POSCTL, -3.0, 0.0, Phase.RELEASED, True),
        (1, LANDING, Px4Mode.AUTO_LAND, -3.0, 0.7, Phase.RELEASED, False),
        # a PX4 whose estimate has run away lies on the ground and stays armed
        (1, LANDING, Px4Mode.AUTO_LAND, 5.1, 0.0, Phase.RELEASED, True),
        (1, LANDING, Px4Mode.AUTO_LAND, -0.29, 0.04, Phase.RELEASED, True),
        (1, LANDING, Px4Mode.AUTO_LAND, -0.31, 0.04, Phase.RELEASED, False),
        (1, LANDING, Px4Mode.AUTO_LAND, -0.29, 0.06, Phase.RELEASED, False),
        (1, LANDING, Px4Mode.AUTO_LAND, 0.0, 0.0, None, True),
        (1, ALOFT, Px4Mode.OFFBOARD, 0.0, 0.0, Phase.MOVING, False),
    ],
)
def test_a_flight_is_over_for_who_is_down_or_in_somebody_elses_hands(
    armed: int, landed: int, mode: Px4Mode, down_m: float, speed_m_s: float, phase: Phase | None, over: bool
) -> None:
    row = np.zeros((), TRUTH_DTYPE)
    row["armed"], row["landed_state"], row["custom_mode"] = armed, landed, mode
    row["position_ned_m"], row["velocity_ned_m_s"] = (300.0, 100.0, down_m), (0.0, speed_m_s, 0.0)
    assert settled(row, phase) is over


def test_who_tells_nothing_is_over() -> None:
    assert settled(None, None)
    assert settled(None, Phase.MOVING)


def test_a_campaign_with_one_broken_flight_says_so_with_an_interval(tmp_path: Path) -> None:
    flight = the_flight(tmp_path)
    good = {**judged(seen_of(truth({1: line(0.0, 1.0), 2: line(8.0, 9.0)}), [1, 2], [], T0), [], flight), "raised": "",
            "stuck": [], "left_in_hold": [], "operator_landed": False}  # fmt: skip
    assert tables_of(flight, "made up", [good] * 4, [1, 2, 3, 4]).broken == ""
    outcome = tables_of(flight, "made up", [good, good | {"stuck": [[1, Phase.MOVING.name]]}, good], [1, 2, 3])
    assert outcome.broken == "1 of 3 flights broke a rule, of seeds 2"
    stuck = next(row for row in outcome.values["rows"] if row["what"] == "stuck flights")
    assert stuck["count"] == 1
    assert "%" in stuck["flights"]
