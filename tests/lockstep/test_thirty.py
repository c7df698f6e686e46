"""Thirty vehicles change their formation with crossing paths: nobody comes close, nobody is stuck."""

import numpy as np
import pytest
from flights import (
    DEFAULT,
    InLockstep,
    distances,
    errors,
    failsafes,
    launch,
    truth,
    until,
    until_formed,
    until_landed,
    wait,
)

from companion.config import FleetConfig, load
from companion.core.values import Phase
from companion.operator.client import Operator

SETTLED_WITHIN_S = 60.0
CLEARANCE_M = 0.75


def thirty() -> FleetConfig:
    def change(tables: dict[str, object]) -> None:
        tables["vehicle"] = [{"id": i} for i in range(1, 31)]
        tables["limits"]["control_rate_hz"] = 25.0  # type: ignore[index]
        tables["plan"] = {"then": "stay"}

    return load(DEFAULT, change)


@pytest.mark.long
@pytest.mark.timeout(900)
def test_thirty_vehicles_change_from_v_to_circle_to_line() -> None:
    config = thirty()
    ls = launch(config, seed=1)
    operator = Operator(config, InLockstep(ls))
    until_formed(ls, 90.0)
    for shape in ("circle", "line"):
        asked_s = ls.now_ns * 1e-9
        assert operator.form(shape, ls.now.fleet_ns).all_accepted
        wait(ls, 0.1)
        assert ls.all_in(Phase.FORMING)
        until(ls, SETTLED_WITHIN_S, lambda: ls.all_in(Phase.FORMED))
        wait(ls, 5.0)
        t = truth(ls, ls.now_ns * 1e-9 - 4.0)
        formation, _ = errors(ls, t, t.ids)
        assert np.sqrt(np.square(formation).mean()) <= 0.2
        assert distances(truth(ls, asked_s)).min() >= CLEARANCE_M
    assert operator.land().all_accepted
    until_landed(ls)
    assert failsafes(ls) == []
    assert distances(truth(ls, 3.0)).min() >= CLEARANCE_M
