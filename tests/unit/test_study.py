"""The studies: shape of their results with a few seeds, refusals, and that finished seeds are not run again."""

import json
import re
from dataclasses import replace
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
from foreign import EXAMPLE, install
from rich.console import Console

pytest.importorskip("numba")
pytest.importorskip("matplotlib")

from companion.core.frames import Ned
from companion.core.values import PeerMessage, PeerSample, Phase
from companion.errors import CompanionError, ConfigError
from companion.wire.peer import encode_state
from sim.study import common, headon
from sim.study.common import load_config, measured, parse_seeds, proportion_interval
from sim.study.faults import _ablated
from sim.study.run import study
from sim.study.scale import step_costs
from sim.study.theory import SETTLED_S, lyapunov, settled_f_m, shortest_interval_s, ultimate_bound
from sim.swarm.swarm import run


def _quiet() -> Console:
    return Console(file=StringIO())


def test_table3_reproduces_the_float_clock_and_ours_sends_least_at_the_smallest_error(tmp_path: Path) -> None:
    study("table3", "0..1", tmp_path, console=_quiet())
    rows = {r["method"]: r for r in json.loads((tmp_path / "table3.json").read_text(encoding="utf-8"))["rows"]}
    clock = rows["periodic, float clock of the paper"]
    assert clock["triggers"] == 1602
    assert round(clock["mean_interval_s"], 4) == 0.0561
    assert clock["published"]["triggers"] == 1602
    assert rows["periodic, true 20 Hz"]["triggers"] == 1800
    ours = rows["ours: flown law"]
    assert ours["triggers"] <= 30
    assert ours["formation_rmse_m"] <= 0.35
    assert ours["published"] is None
    literal = rows["switching (paper), literal"]
    assert literal["speed_end_m_s"] < 0.1
    assert literal["formation_rmse_m"] > 10 * ours["formation_rmse_m"]
    for key in ("method", "triggers", "mean_interval_s", "formation_rmse_m", "formation_rmse_centred_m",
                "velocity_rmse_m_s", "published"):  # fmt: skip
        assert key in ours
    for name in ("table3_table.csv", "table3_messages.png", "table3_messages.svg", "table3.html"):
        assert (tmp_path / name).stat().st_size > 0
    page = (tmp_path / "table3.html").read_text(encoding="utf-8")
    assert "fleet study table3 --seeds 0..1" in page
    assert "data:image/png;base64," in page
    assert "elastic_amplitude" in page, "the set-up is part of the report"


def test_finished_seeds_are_read_back_and_a_changed_setup_is_run_anew(tmp_path: Path) -> None:
    config = load_config("example2")
    ran: list[int] = []
    first = common.pieces(config, [0], tmp_path, 1, lambda: ran.append(0))
    piece = next((tmp_path / "pieces").glob("example2-*.json"))
    written = piece.stat().st_mtime_ns
    again = common.pieces(config, [0], tmp_path, 1, lambda: ran.append(1))
    assert json.dumps(first) == json.dumps(again)
    assert piece.stat().st_mtime_ns == written
    changed = replace(config, text=config.text + "\n# another\n")
    assert common.fingerprint(changed) != common.fingerprint(config)


def test_example1_interval_is_the_published_one_under_v1b() -> None:
    gaps = run(load_config("example1").base, 0).intervals_s()
    assert gaps.mean() == pytest.approx(0.181, abs=0.008)
    assert np.median(gaps) == pytest.approx(0.180, abs=0.0051)


def test_example2_tips_send_less_and_errors_are_the_published_ones() -> None:
    config = load_config("example2")
    flown = run(config.base, 0)
    counts = flown.per_agent()
    assert counts[[0, 5]].min() >= 135
    assert counts[[0, 5]].max() <= 170
    assert np.delete(counts, [0, 5]).min() > counts[[0, 5]].max() + 15


def test_literal_equation_brakes_and_the_flown_law_does_not() -> None:
    config = load_config("example1")
    literal, flown = run(config.one("literal"), 0), run(config.one("flown"), 0)
    assert measured(literal)["speed_end_m_s"] < 0.05
    assert measured(flown)["speed_end_m_s"] == pytest.approx(0.8, abs=0.02)


@pytest.mark.parametrize("scenario", ["calm V", "gust 0.3, lag 0.3 s", "all of them"])
def test_ours_sends_99_percent_fewer_than_20_hz_at_no_larger_error(scenario: str) -> None:
    config = load_config("pareto")
    setup = config.cases()[scenario]
    schemes = config.on(setup, "schemes")
    f: dict[str, float] = {}
    for name in ("20 Hz", "flown law", "published intent"):
        records = [measured(run(schemes[name], seed)) for seed in range(3)]
        f[name] = float(np.mean([r["f_m"] for r in records]))
        if name != "20 Hz":
            assert np.mean([r["fewer_percent"] for r in records]) > 98.8
    floor = 0.012
    assert f["flown law"] < max(1.1 * f["20 Hz"], floor)
    assert f["published intent"] < max(1.1 * f["20 Hz"], floor)


def test_leaderless_vehicles_keep_the_velocity_they_started_with() -> None:
    config = load_config("pareto")
    setup = replace(config.cases()["leaderless, gust 0.3, 300 s"], duration_s=60.0)
    for name in ("flown law", "published intent"):
        record = measured(run(config.on(setup, "schemes")[name], 1))
        assert record["mean_velocity_off_m_s"] < 0.06
        assert record["fewer_percent"] > 98.8


def test_nobody_collides_with_everything_at_once_and_the_barrier_is_why() -> None:
    config = load_config("faults")
    crossing = config.cases()["all of them, crossing starts"]
    assert min(run(crossing, s).measures["minimum_distance_m"] for s in range(3)) > 0.5
    cases = _ablated(config)
    kept = [run(cases["with everything"], s).measures["minimum_distance_m"] for s in range(4)]
    bare = [run(cases["without either"], s).measures["minimum_distance_m"] for s in range(4)]
    assert min(kept) > 0.5
    assert np.median(bare) < np.median(kept)


def test_proof_fails_for_the_common_mode_and_intervals_respect_their_bound() -> None:
    config = load_config("theory")
    flown = run(next(iter(config.cases().values())), 0)
    v = lyapunov(flown)
    assert v["disagreement"][-1] < 0.01 * v["c1_side"][-1]
    assert (v["v3"] >= 0).all()
    assert flown.intervals_s().min() >= shortest_interval_s(flown)


def test_the_bound_on_the_shape_is_the_closed_form_where_everyone_hears_everyone() -> None:
    """s^2 + (k_a (n + 1)/n + k_v) s + k_c (n + 1)/n does not swing, and a held neighbour's error is divided by n."""
    config = load_config("theory")
    setup = replace(config.one("flown"), k_a=3.0, k_c=4.0, k_v=1.0, k_p=0.3, gamma_s2=0.1)
    found, n = ultimate_bound(setup), 9
    stiffness = 4.0 * (n + 1) / n
    assert found["lambda2"] == pytest.approx(n + 1)
    assert found["gain_gust_s2"] == pytest.approx(1.0 / stiffness, rel=1e-3)
    held = np.hypot(4.0 - 0.3 * n / (n + 1), 3.0 / np.sqrt(0.1)) / n
    assert found["gain_held"] == pytest.approx(held / stiffness, rel=1e-3)


def test_the_bound_on_the_shape_grows_with_threshold_and_gusts_and_as_the_graph_thins() -> None:
    config = load_config("theory")
    base = config.on(config.one("flown"), "ultimate")["N = 12, ring of 4 neighbours"]
    bound = ultimate_bound(base)["bound_m"]
    assert ultimate_bound(replace(base, epsilon_m=0.3))["bound_m"] > bound
    assert ultimate_bound(replace(base, gust_m_s2=0.4))["bound_m"] > bound
    assert (
        ultimate_bound(replace(base, range_m=2.2))["bound_m"]
        > bound
        > ultimate_bound(replace(base, range_m=9.0))["bound_m"]
    )


@pytest.mark.parametrize("case", ["N = 10, all hear all", "N = 10, calm", "leaderless, N = 10, all hear all"])
def test_the_formation_stays_within_the_bound_on_its_shape(case: str) -> None:
    config = load_config("theory")
    setup = config.on(replace(config.one("flown"), links=False), "ultimate")[case]
    f = settled_f_m(run(setup, 200))
    assert len(f) > SETTLED_S
    assert f.max() <= ultimate_bound(setup)["bound_m"]


def test_the_cost_of_a_step_grows_as_the_number_of_agents_and_not_as_its_square() -> None:
    config = load_config("scale")

    def cost(count: int) -> dict[str, float]:
        return step_costs(replace(config.base, formation=replace(config.base.formation, count=count)), 0, 30, 0.35)

    few, many = cost(500), cost(4000)
    assert many["neighbours"] > 40
    # Eight times the agents: 64 times the cost if it were dense; the largest share of neighbours is inside too.
    assert many["step_ms"] < 32.0 * few["step_ms"]


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"name": "example9"}, "there is no study 'example9'"),
        ({"name": "table3", "seeds": ","}, "names no seed"),
        ({"name": "table3", "seeds": ""}, "names no seed"),
        ({"name": "table3", "seeds": "5..3"}, "names no seed"),
        ({"name": "table3", "seeds": "a..b"}, "must look like 0..19"),
        ({"name": "table3", "jobs": 0}, "--jobs must be at least 1"),
        ({"name": "table3", "out": Path("/proc/nowhere")}, "nothing can be written there"),
        ({"name": "table3", "setup": Path("missing.toml")}, "cannot be read"),
    ],
)
def test_a_study_that_cannot_be_run_is_refused_with_a_sentence(
    tmp_path: Path, arguments: dict[str, object], says: str
) -> None:
    given = {"out": tmp_path, "console": _quiet(), **arguments}
    with pytest.raises(ConfigError, match=says):
        study(**given)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("[base.formation]\ncount = 1\n", "formation.count must be at least 2"),
        ("[base]\nrange_m = 0.5\n", "not connected at range_m"),
        ("[base]\nspeed = 3\n", "is not a setting"),
        ("[base\n", "is not valid TOML"),
    ],
)
def test_a_users_own_setup_is_checked(tmp_path: Path, text: str, says: str) -> None:
    path = tmp_path / "own.toml"
    path.write_text(f"{text}\n[cases]\n[nulls]\n[published]\n", encoding="utf-8")
    with pytest.raises(ConfigError, match=says):
        study("table3", "0", tmp_path, setup=path, console=_quiet())


def test_seeds_are_ranges_with_both_ends_or_lists() -> None:
    assert parse_seeds("0..3") == (0, 1, 2, 3)
    assert parse_seeds("7, 2,2") == (7, 2)


def test_none_of_twenty_has_an_interval() -> None:
    low, high = proportion_interval(0, 20)
    assert low == 0.0
    assert high == pytest.approx(0.168, abs=0.001)


def test_bytes_are_counted_as_the_wire_has_them() -> None:
    sample, other = (PeerSample(i, 0, Ned(0.0, 0.0, 0.0), Ned(0.0, 0.0, 0.0), 1, Phase.FORMED) for i in (1, 2))
    message = PeerMessage(1, 1, 0, 0, sample, ())
    assert len(encode_state(message)) == common.MESSAGE_BYTES
    longer = PeerMessage(1, 1, 0, 0, sample, (other,))
    assert len(encode_state(longer)) == common.MESSAGE_BYTES + common.DIGEST_ENTRY_BYTES


def test_two_sent_head_on_by_a_broken_law_keep_their_distance_and_without_the_filter_collide() -> None:
    """The bar's row of the table, on three seeds: 0.3 s of lag, 100 ms of delay, event-triggered."""
    meeting = headon.meeting_of(load_config("headon"))
    assert meeting.speed_m_s == 2.0
    for seed in range(3):
        kept = headon.meet(meeting, seed, lag_s=0.3, delay_s=0.1, loss=0.0)
        assert kept["minimum_distance_m"] >= 0.9
        assert kept["passed"]
        assert kept["messages"] < 200
    without = headon.meet(meeting, 0, lag_s=0.3, delay_s=0.1, loss=0.0, barrier=False)
    assert without["minimum_distance_m"] < headon.COLLISION_M


def test_the_head_on_study_writes_its_table_and_the_edge_of_the_safe_region(tmp_path: Path) -> None:
    setup = tmp_path / "small.toml"
    text = Path(headon.__file__).with_suffix(".toml").read_text(encoding="utf-8")
    for key, values in (("lags_s", [0.3]), ("delays_s", [0.0, 0.1]), ("losses", [0.0])):
        text = re.sub(rf"^{key} = .*", f"{key} = {values}", text, flags=re.MULTILINE)
    setup.write_text(text, encoding="utf-8")
    study("headon", "0", tmp_path, setup=setup, console=_quiet())
    found = json.loads((tmp_path / "headon.json").read_text(encoding="utf-8"))
    assert [(r["lag_s"], r["delay_ms"]) for r in found["rows"]] == [(0.3, 0.0), (0.3, 100.0)]
    assert found["edges"] == [{"lag_s": 0.3, "loss_percent": 0.0, "safe_ms": 100.0}]
    assert [r["close_count"] for r in found["compared"]][:3] == [0, 1, 0]
    for name in ("headon_table.csv", "headon_edge.csv", "headon.png", "headon.svg", "headon.html"):
        assert (tmp_path / name).stat().st_size > 0


def test_a_head_on_meeting_below_its_bar_ends_the_command_with_a_sentence(tmp_path: Path) -> None:
    """The same flight without the filter, were it to keep what the one with it must."""
    setup = tmp_path / "blind.toml"
    text = Path(headon.__file__).with_suffix(".toml").read_text(encoding="utf-8")
    for key, values in (("lags_s", "[0.3]"), ("delays_s", "[0.1]"), ("losses", "[0.0]")):
        text = re.sub(rf"^{key} = .*", f"{key} = {values}", text, flags=re.MULTILINE)
    table, _, blind, *_ = text.split("[[compared]]\n")
    setup.write_text(table + "[[compared]]\n" + blind.replace("must_m = 0.0", "must_m = 0.9"), encoding="utf-8")
    with pytest.raises(
        CompanionError, match=r"^without the filter: two came to 0\.\d\d m, must be 0\.9 m: .*headon\.html$"
    ):
        study("headon", "0", tmp_path, setup=setup, console=_quiet())


@pytest.mark.parametrize(("missing", "more"), [("gust_m_s2", ""), ("", "speed")])
def test_a_head_on_set_up_with_missing_or_unknown_keys_is_refused(missing: str, more: str) -> None:
    config = load_config("headon")
    given = {k: v for k, v in config.values["meeting"].items() if k != missing} | ({more: 2.0} if more else {})
    with pytest.raises(ConfigError, match=f"wrong: {missing or more}$"):
        headon.meeting_of(replace(config, values={"meeting": given}))


def test_the_law_of_another_package_is_found_wherever_in_a_setup_and_is_part_of_what_names_finished_seeds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(install(EXAMPLE, tmp_path / "site")))
    ours = {"base": {"law": "flown"}, "cases": {"a": {"law": "starling", "law_parameters": {"k_s": 1.0}}}}
    assert common.foreign_laws(ours) == []
    (found,) = common.foreign_laws({**ours, "schemes": {"b": {"law": "springs"}, "c": {"law": "springs"}}})
    assert (found.kind, found.package) == ("springs", "starling-springs")
    config = load_config("table3")
    marks = set()
    for origins in ([], [found], [found._replace(source="other")]):
        monkeypatch.setattr(common, "foreign_laws", lambda _, o=origins: o)
        marks.add(common.fingerprint(config))
    assert len(marks) == 3
