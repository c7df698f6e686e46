"""Flights in which peers fall silent, start anew or lie; how near the vehicles come to each other by truth."""

from collections.abc import Sequence
from math import inf
from typing import Any

import numpy as np
from flights import distances, fleet, launch, set_parameter, truth, until, until_formed, wait

from companion.core.frames import Ned
from companion.core.values import ZERO, PeerMessage, PeerSample, Phase
from companion.core.vectors import lerp
from companion.wire.mavlink import ON_GROUND
from companion.wire.peer import encode_state
from sim.lockstep.lockstep import Lockstep

TURN: list[dict[str, object]] = [{"kind": "turn", "rate_deg_s": 6.0}]


def moving(
    count: int, shape: str, seed: int, legs: Sequence[dict[str, object]], spacing_m: float = 4.0, t_max_s: float = 10.0
) -> Lockstep:
    """A formation at 6 m that flies its legs, for 6 s so far."""

    def change(tables: dict[str, Any]) -> None:
        tables["formation"]["spacing_m"] = spacing_m
        tables["trigger"]["t_max_s"] = t_max_s
        tables["limits"]["control_rate_hz"] = 25.0

    ls = launch(fleet(count, altitude_m=6.0, shape=shape, legs=legs, change=change), seed=seed)
    until_formed(ls)
    until(ls, 10.0, lambda: ls.all_in(Phase.MOVING))
    wait(ls, 6.0)
    return ls


def states_lost(count: int, seed: int, shape: str = "v", t_max_s: float = 10.0) -> tuple[float, Lockstep]:
    """Everybody's states are lost in a turn of 6 °/s while presence stays; the least distance from then on (m)."""
    ls = moving(count, shape, seed, [{"kind": "velocity", "north_m_s": 1.0, "duration_s": 4.0}, *TURN], t_max_s=t_max_s)
    wait(ls, 3.0 + seed % 9)
    since_s = ls.now_ns * 1e-9
    ls.drop_topic("state")
    ls.run_until(since_s + 90.0, lambda: ls.all_in(Phase.LANDED))
    return airborne_distance(ls, since_s), ls


def airborne_distance(ls: Lockstep, since_s: float, about: int | None = None) -> float:
    """The least distance of two vehicles of which one is in the air (m); with `about`, to that vehicle."""
    t = truth(ls, since_s)
    a, b = np.triu_indices(len(t.ids), 1)
    flying = t.landed_state != ON_GROUND
    either = flying[:, a] | flying[:, b]
    if about is not None:
        k = t.column(about)
        either = either & ((a == k) | (b == k))
    return float(np.where(either, distances(t), inf).min())


def restarted(shape: str, seed: int, line: bool, stops: bool = True) -> tuple[float, int, Lockstep]:
    """A companion is killed in flight and starts anew; the least distance to its vehicle (m), and its id.

    Its autopilot stops it in the others' way, or lands it.
    """
    ls = moving(
        5, shape, seed, [{"kind": "velocity", "north_m_s": 1.0, "duration_s": 25.0}], 3.0 if shape == "column" else 4.0
    )
    slots = ls.vehicles[1].agent.history.newest.slots
    order = sorted(slots, key=lambda i: slots[i].after.north)
    i = order[-1 - seed % 2]
    if stops:
        set_parameter(ls, i, "COM_OBL_RC_ACT", 5)
    since_s = ls.now_ns * 1e-9
    ls.kill(i)
    wait(ls, 0.3 + 0.4 * (seed % 5))
    ls.restart(i, line_dead_s=0.0 if line else inf)
    ls.run_until(since_s + 100.0, lambda: all(p is Phase.LANDED for j, p in ls.phases().items() if j != i))
    return airborne_distance(ls, since_s, i), i, ls


class Liar:
    """Somebody inside who speaks under vehicle 2's id, and what that does to a V of five at 1 m/s, or to another
    flight."""

    def __init__(self, seed: int = 3, flight: Lockstep | None = None) -> None:
        legs = [{"kind": "velocity", "north_m_s": 1.0, "duration_s": 200.0}]
        self.ls = flight or moving(5, "v", seed, legs)
        self.since_s = self.ls.now_ns * 1e-9
        self.sequence = 0

    def sample(self, i: int, **changed: Any) -> PeerSample:
        """What vehicle i could truly say now, with something changed."""
        agent = self.ls.vehicles[i].agent
        newest = agent.history.newest
        r = newest.reference(i, self.ls.now.fleet_ns)
        made = PeerSample(i, self.ls.now.fleet_ns, r.position_ned_m, r.velocity_ned_m_s, newest.revision, Phase.MOVING)
        return made._replace(**changed)

    def says(self, sample: PeerSample, boot_id: int = 1, digest: tuple[PeerSample, ...] = ()) -> None:
        """All hear it."""
        newest = self.ls.vehicles[1].agent.history.newest
        self.sequence += 1
        message = PeerMessage(boot_id, self.sequence, newest.start_ns, newest.issuer, sample, digest)
        self.ls.inject_peer(f"fleet/{sample.vehicle_id}/state", encode_state(message), *self.ls.vehicles)

    def beside(self, i: int, north_m: float, east_m: float, **changed: Any) -> PeerSample:
        """Vehicle 2 where vehicle i is, or so far from there."""
        p = self.ls.positions()[i]
        return self.sample(2, position_ned_m=Ned(p.north + north_m, p.east + east_m, p.down), **changed)

    def least_m(self) -> float:
        return airborne_distance(self.ls, self.since_s)

    def pushed_m(self) -> float:
        """The farthest that any vehicle was from its slot, by truth."""
        t = truth(self.ls, self.since_s)
        history = self.ls.vehicles[1].agent.history
        worst = 0.0
        for time_ns, row in zip(t.times_ns[::5], t.position_ned_m[::5], strict=True):
            moment = history.at(int(time_ns)).state_at(int(time_ns))
            slots = history.at(int(time_ns)).slots
            for i, p in zip(t.ids, row, strict=True):
                worst = max(worst, float(np.linalg.norm(p - np.array(moment.slot(slots[i]).position_ned_m))))
        return worst


def all_have_landed(liar: Liar, k: int) -> None:
    for i in liar.ls.vehicles:
        liar.says(liar.sample(i, phase=Phase.LANDED, velocity_ned_m_s=ZERO), boot_id=k)
        liar.says(liar.sample(2), digest=tuple(liar.sample(j, phase=Phase.LANDED) for j in (1, 3, 4)))


def teleports(liar: Liar, k: int) -> None:
    liar.says(liar.beside(1 + 2 * (k % 3), 0.3, 0.3))


def alternates(liar: Liar, k: int) -> None:
    liar.says(liar.beside(4, 0.5, 0.0), boot_id=k % 2)


def drifts(liar: Liar, k: int) -> None:
    """Salami: each step is a motion that a vehicle could fly, to where vehicle 1 is, and on it."""
    p, q = liar.sample(2).position_ned_m, liar.ls.positions()[1]
    share = min(0.03 * k, 1.0)
    liar.says(liar.sample(2, position_ned_m=lerp(p, q, share)))


def drifts_from_ahead(liar: Liar, k: int) -> None:
    """The same, from as far in the future as is taken, so that the vehicle's own words are older."""
    ahead_ns = 900_000_000
    p, q = liar.sample(2).position_ned_m, liar.ls.positions()[1]
    place = lerp(p, q, min(0.03 * k, 1.0))
    liar.says(
        liar.sample(2, position_ned_m=place._replace(north=place.north + 0.9), time_ns=liar.ls.now.fleet_ns + ahead_ns)
    )


def moves_third_parties(liar: Liar, k: int) -> None:
    liar.says(liar.sample(2), digest=tuple(
        liar.sample(j, position_ned_m=liar.ls.positions()[1]._replace(down=-6.0 + 0.01 * k)) for j in (3, 4, 5)
    ))  # fmt: skip


def sequence_from_the_end(liar: Liar, k: int) -> None:
    if k == 0:
        liar.sequence = (1 << 31) - 6
        for i in liar.ls.vehicles:
            liar.says(liar.sample(i), boot_id=liar.ls.vehicles[i].agent.boot_id)


LIES = {
    f.__name__: f
    for f in (
        all_have_landed,
        teleports,
        alternates,
        drifts,
        drifts_from_ahead,
        moves_third_parties,
        sequence_from_the_end,
    )
}


def lied_to(name: str, seed: int = 3, seconds: float = 8.0, rate_hz: float = 5.0) -> Liar:
    """A flight in which somebody lies so often for so long, and a while after it."""
    liar = Liar(seed)
    for k in range(round(seconds * rate_hz)):
        LIES[name](liar, k)
        wait(liar.ls, 1.0 / rate_hz)
    wait(liar.ls, 6.0)
    return liar
