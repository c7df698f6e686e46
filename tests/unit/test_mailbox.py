"""What waits for the loop: nobody drives out another kind, and a turn is bounded."""

from dataclasses import dataclass

from hypothesis import given
from hypothesis import strategies as st

from companion.io.mailbox import BOUNDS, OTHERWISE, Bound, Mailbox

KINDS = sorted(BOUNDS)


@dataclass(frozen=True)
class Item:
    kind: str
    received_monotonic_ns: int


def filled(**counts: int) -> Mailbox[Item]:
    box = Mailbox[Item]()
    number = 0
    for kind, count in counts.items():
        for _ in range(count):
            box.put(kind, Item(kind, number))
            number += 1
    return box


def test_a_flood_of_one_kind_drives_out_its_own_oldest_and_no_command_or_plan() -> None:
    box = filled(command=1, plan=1, status=100_000, state=100_000)
    assert len(box) == 1 + 1 + BOUNDS["status"].waiting + BOUNDS["state"].waiting
    assert box.dropped == 200_002 - len(box)
    first = box.take()
    assert [i.kind for i in first[:2]] == ["command", "plan"]
    newest = 100_001
    assert [i.received_monotonic_ns for i in first if i.kind == "status"] == list(range(newest - 15, newest - 11))


def test_all_that_waits_is_taken_in_turns_of_a_bounded_size() -> None:
    box = filled(command=5, status=9, state=1000)
    turns = []
    while len(box):
        turns.append([i.kind for i in box.take()])
    for turn in turns:
        assert all(turn.count(kind) <= BOUNDS[kind].a_turn for kind in KINDS)
    assert [turn.count("command") for turn in turns] == [2, 2, 1, 0]
    assert sum(map(len, turns)) == 1014
    assert box.take() == []


@given(st.lists(st.sampled_from([*KINDS, "another", "one more"]), max_size=200), st.integers(1, 9), st.integers(1, 9))
def test_each_kind_comes_in_its_order_and_what_is_not_taken_is_counted(
    kinds: list[str], waiting: int, a_turn: int
) -> None:
    box = Mailbox[Item]({kind: Bound(waiting, a_turn) for kind in KINDS})
    for number, kind in enumerate(kinds):
        box.put(kind, Item(kind, number))
    taken = []
    while len(box):
        turn = box.take()
        assert [i.received_monotonic_ns for i in turn] == sorted(i.received_monotonic_ns for i in turn)
        taken += turn
    assert len(taken) + box.dropped == len(kinds)
    for kind in KINDS:
        mine = [i.received_monotonic_ns for i in taken if i.kind == kind]
        assert mine == [n for n, k in enumerate(kinds) if k == kind][-waiting:]
    assert len([i for i in taken if i.kind not in KINDS]) <= OTHERWISE.waiting
