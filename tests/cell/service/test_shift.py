"""The ledger of a shift: what it counts, and that it stays small."""

from datetime import datetime
from types import SimpleNamespace
from typing import Any

import pytest

from cell.config.model import CellConfig
from cell.control.answer import Answer
from cell.errors import NoPartFound
from cell.jobs import sort
from cell.plugin import tasks
from cell.plugin.goals import IdentifyGoal, SortGoal
from cell.service.shift import KEPT_ANSWERS, Shift, began_s
from tests.values import raising


class Wall:
    """A wall clock that the test sets."""

    def __init__(self) -> None:
        self.now_s = datetime(2027, 3, 1, 8, 0).timestamp()

    def __call__(self) -> float:
        return self.now_s


def part(label: str = "ball", seconds: float = 4.0, **fields: Any) -> Answer:
    others = {"ball": 0.1, "box": 0.05, "UNKNOWN": 0.02, label: 0.83}
    known = {"label": label, "probabilities": others, "n_grasps": 2, "seconds": seconds}
    return Answer(task="sort", **known | fields)


def test_a_fresh_shift_has_no_figures() -> None:
    found = Shift(wall_clock=Wall()).values()
    assert (found["parts"], found["cycle_s"], found["parts_last_hour"]) == (0, None, 0)
    assert (found["counts"], found["answers"]) == ({}, [])


def test_parts_rejects_misses_and_faults_are_counted_apart() -> None:
    clock = Wall()
    shift = Shift(n_faults=lambda: 2, wall_clock=clock)
    for answer in (
        part("ball", seconds=3.0, place="left"),
        part("box", seconds=5.0, place="right"),
        part("UNKNOWN", seconds=9.0, place="reject", rejected=True),
        Answer(task="sort", seconds=7.0),
    ):
        clock.now_s += 60.0
        shift.add(answer)
    found = shift.values()
    assert (found["parts"], found["rejected"], found["missed"], found["faults"]) == (3, 1, 1, 2)
    assert found["counts"] == {"ball": 1, "box": 1, "UNKNOWN": 1}
    assert found["cycle_s"] == 5.0
    assert found["parts_last_hour"] == 3
    first = found["answers"][0]
    assert (first["number"], first["label"], first["place"]) == (1, "ball", "left")
    assert first["runner_up"] == {"label": "box", "probability": 0.05}
    assert first["time_s"] == found["since_s"] + 60.0


def test_the_parts_of_the_last_hour_are_counted() -> None:
    clock = Wall()
    shift = Shift(wall_clock=clock)
    counted = []
    for _ in range(30):
        shift.add(part())
        clock.now_s += 1.0
        counted.append(shift.values()["parts_last_hour"])
    assert counted == list(range(1, 31))
    clock.now_s += 3584.5  # the first half is older than an hour now
    assert shift.values()["parts_last_hour"] == 15
    clock.now_s += 3600.0
    assert shift.values()["parts_last_hour"] == 0
    shift.add(part())
    assert shift.values()["parts_last_hour"] == 1


def test_the_ledger_stays_small() -> None:
    clock = Wall()
    shift = Shift(wall_clock=clock)
    for number in range(5000):
        clock.now_s += 1.0
        shift.add(part(curves={"t_s": [float(number)]}))
    found = shift.values()
    assert found["parts"] == 5000
    assert found["parts_last_hour"] == 3600
    assert [one["number"] for one in found["answers"]] == list(range(5001 - KEPT_ANSWERS, 5001))
    newest = shift.part(5000)
    assert newest.curves == {"t_s": [4999.0]}
    assert shift.part(5000 - KEPT_ANSWERS) is None
    assert (len(shift._times_s), len(shift._cycles_s), len(shift.parts)) == (3600, 1000, 20)


@pytest.mark.parametrize(
    ("now", "begins_h", "began"),
    [
        ((1, 8, 0), (0.0,), (1, 0, 0)),
        ((1, 5, 59), (6.0, 14.0, 22.0), (0, 22, 0)),
        ((1, 6, 0), (22.0, 6.0, 14.0), (1, 6, 0)),
        ((1, 21, 59), (6.0, 14.0, 22.0), (1, 14, 0)),
        ((1, 5, 0), (5.5,), (0, 5, 30)),
    ],
)
def test_a_shift_begins_at_hours_of_the_local_day(now: Any, begins_h: Any, began: Any) -> None:
    at_s = [datetime(2027, 3, 1 + day, *time).timestamp() for day, *time in (now, began)]
    assert began_s(at_s[0], begins_h) == at_s[1]


def test_a_new_shift_begins_with_no_figures_and_parts_keep_their_numbers() -> None:
    clock, faults = Wall(), [0]
    shift = Shift((6.0, 14.0), lambda: faults[0], clock)
    for n_parts in (3, 0, 2):
        for _ in range(n_parts):
            shift.add(part())
        faults[0] += 1
        found = shift.values()
        assert (found["parts"], found["faults"], found["counts"].get("ball", 0)) == (
            n_parts, 1, n_parts,
        )  # fmt: skip
        clock.now_s = found["since_s"] + 16.1 * 3600.0
        assert shift.values()["parts"] == shift.values()["faults"] == 0
    assert [one.number for one in shift.parts] == [1, 2, 3, 4, 5]


@pytest.mark.parametrize("leap_s", [-4000.0, -1e8, 1e8])
def test_a_clock_that_leaps_lets_no_times_grow(leap_s: float) -> None:
    clock = Wall()
    shift = Shift(wall_clock=clock)
    for _ in range(10):
        shift.add(part())
    clock.now_s += leap_s
    shift.add(part())
    assert shift.values()["parts_last_hour"] == len(shift._times_s) == 1
    assert shift.values()["parts"] == (11 if abs(leap_s) < 1e4 else 1)


def test_turns_without_a_part_are_reported_as_such(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[Any] = []
    nothing: Any = None
    model: Any = SimpleNamespace(max_grasps=1)

    for module in (tasks, sort):
        monkeypatch.setattr(module, "identify", raising(NoPartFound("no contact")))

    def places() -> tasks.Places:
        return tasks.Places(CellConfig(), ("ball",))

    file = tasks.ModelFile(model, None)
    cell = tasks.Tasks(nothing, file, places, lambda: seen.append)
    with pytest.raises(NoPartFound):
        cell.identify(IdentifyGoal(), lambda _now: None)
    answer = cell.sort(SortGoal(parts=2), lambda _now: None)
    assert (answer.n_missed, answer.n_parts) == (2, 0)
    assert seen == [Answer(), *2 * [Answer(task="sort")]]
