"""Agents whose law is not compiled: each has its own, made by its table as a vehicle's is, and its plain `command` is
called in every control period. Interpreted, so slower by two orders of magnitude; the rest of the step is compiled.

As in a vehicle, only the level part of the command is flown, within `a_max_m_s2`. Altitude is flown by position, with
the cascade that PX4 has for it.
"""

from struct import Struct
from typing import Any

from companion.config.law_tables import LawTable
from companion.core.counts import Counts
from companion.core.frames import Ned
from companion.core.trajectory.fleet import Reference
from companion.core.values import Neighbour, VehicleState
from companion.errors import ConfigError
from companion.vehicle.guest import GUESTS, LAW_NOT_FINITE, LAW_RAISED, GuestLaw
from sim.swarm.command import keep_apart, look
from sim.swarm.compiled import kernel
from sim.swarm.kernels import exchange, fly
from sim.swarm.state import TOLD, Floats, Options, State

ALTITUDE_PER_S, CLIMB_PER_S = 1.0, 4.0
"""MPC_Z_P and MPC_Z_VEL_P_ACC of PX4"""


class PlainLaws:
    """One law for each agent."""

    def __init__(self, table: LawTable, count: int, r0_m: float) -> None:
        """`count` laws with this range of separation."""
        self.kind = table.kind
        self.failures = Counts(GUESTS)
        self.laws = [GuestLaw(table.law(r0_m), table.a_max_m_s2, self.failures) for _ in range(count)]
        self.fields = len(self.laws[0].fields)
        self.floats = Struct(f"<{self.fields}f")
        for law in self.laws:
            law.reset()

    def advance(self, k0: int, k1: int, keep_every: int, s: Any, ref: Floats, o: Any, *rules: Any) -> None:
        """As `kernels.advance`."""
        _, ig, et, st, it = rules
        for k in range(k0, k1):
            exchange(k, keep_every, s, ref, o, ig, et, st, it)
            if k % o.every == 0:
                self._command(k, s, ref, o)
            fly(k, s, o)

    def _command(self, k: int, s: State, ref: Floats, o: Options) -> None:
        for i, law in enumerate(self.laws):
            count = known(i, k, s, ref, o)
            neighbours = [self._neighbour(q, k, s, o) for q in range(count)]
            own, plan = s.measured[i].tolist(), ref[k, i if ref.shape[1] > 1 else 0].tolist()
            ego = VehicleState(k * o.dt_ns, Ned(*own[:3]), Ned(*own[3:]))
            reference = Reference(Ned(*s.slot[i].tolist()), Ned(*plan[3:6]), Ned(*plan[6:9]), 0.0)
            wanted, residual = law.command(ego, reference, neighbours, alone=False)
            s.told[i, : self.fields] = law.tell()
            if self.failures[LAW_RAISED] or self.failures[LAW_NOT_FINITE]:
                raise ConfigError(
                    f"law {self.kind!r} raised, or said no finite number, for agent {i} at {k * o.dt:g} s: "
                    f"fleet law check {self.kind}"
                )
            climb = plan[5] + ALTITUDE_PER_S * (reference.position_ned_m.down - own[2])
            down = plan[8] + CLIMB_PER_S * (climb - own[5])
            s.residual[i] = residual
            s.neighbours[i] = sum(n.in_formation for n in neighbours)
            command(i, k, count, wanted.north, wanted.east, down, s, ref, o)

    def _neighbour(self, q: int, k: int, s: State, o: Options) -> Neighbour:
        e = s.near_row[q]
        j = int(s.column[e])
        sample, step = (s.held[e], s.held_step[e]) if o.links == 1 else (s.sent[j], s.sent_step[j])
        r = s.near[q].tolist()
        told = self.floats.unpack(self.floats.pack(*sample[TOLD : TOLD + self.fields]))
        return Neighbour(
            j + 1, Ned(*r[:3]), Ned(*r[3:6]), Ned(*r[6:9]), float(k - step) * o.dt, r[9] > 0.0, r[10] > 0.0, r[11],
            Ned(*r[13:16]) if r[12] > 0.0 else None, Ned(*r[16:19]), Ned(*r[19:22]), told,
        )  # fmt: skip


@kernel
def known(i: int, k: int, s: State, ref: Floats, o: Options) -> int:
    """`command.look` of agent i, whose common velocity is the plan's."""
    m = i if ref.shape[1] > 1 else 0
    return look(i, k, s.measured[i], Ned(ref[k, m, 3], ref[k, m, 4], ref[k, m, 5]), s, ref, o)


@kernel
def command(
    i: int, k: int, count: int, u0: float, u1: float, u2: float, s: State, ref: Floats, o: Options
) -> None:  # fmt: skip
    """`command.keep_apart` of agent i, whose slot accelerates as the plan says."""
    m = i if ref.shape[1] > 1 else 0
    velocity = Ned(ref[k, m, 3], ref[k, m, 4], ref[k, m, 5])
    keep_apart(i, count, u0, u1, u2, k, velocity, Ned(ref[k, m, 6], ref[k, m, 7], ref[k, m, 8]), s, o)
