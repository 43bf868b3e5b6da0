"""Each benchmark runs to its end and prints its ratios: a figure that is quoted can be measured.

How fast anything is, is not tested here. Each benchmark itself ends with an error where its
alternatives do not give the same.
"""

import importlib
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

import benchmarks
from benchmarks import __main__ as command
from benchmarks._measure import Timed, in_turns, ratio, same
from benchmarks.paper import sweep
from benchmarks.performance import _servo_clients, identify, servo_bus, tactile_path

pytestmark = pytest.mark.no_cover  # to count lines takes as long again as to run them

EFFORT = 0.01
MODULES = command.modules()
TESTED_ELSEWHERE = {"reproduction"}
"""`test_paper` prints the study that it has made, which takes longest of all."""

IN_REAL_TIME = {"servo_bus"}
"""Its processes miss each other's answers beside other tests."""


@pytest.fixture(autouse=True)
def one_blas_thread() -> Iterator[None]:
    """Do as the command does: here numpy was loaded before it could say so."""
    with threadpool_limits(1):
        yield


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[pytest.mark.hil] if name in IN_REAL_TIME else [])
        for name in sorted(MODULES.keys() - TESTED_ELSEWHERE)
    ],
)
def test_it_prints_its_ratios(
    name: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("TACTILE_CELL_DATA", raising=False)
    monkeypatch.chdir(Path(benchmarks.__file__).resolve().parent.parent)
    importlib.import_module(MODULES[name]).main(EFFORT)
    printed = capsys.readouterr().out
    assert printed.startswith(("compared", "408 simulated taxels"))
    assert "  ratio" in printed
    assert "nan" not in printed


def test_the_command_names_what_there_is(monkeypatch: pytest.MonkeyPatch) -> None:
    assert {"identify", "servo_bus", "sweep", "tactile_path"} <= set(MODULES)
    monkeypatch.setattr(sys, "argv", ["benchmarks", "nothing"])
    with pytest.raises(SystemExit, match=", ".join(MODULES)):
        command.main()


def test_alternatives_take_turns_and_begin_in_turn() -> None:
    order: list[str] = []
    found = in_turns({name: lambda n=name: order.append(n) or n for name in "abc"}, 2)
    assert "".join(order) == "abcbca"
    assert found == {"a": ["a", "a"], "b": ["b", "b"], "c": ["c", "c"]}
    assert ratio([1.0, 9.0, 4.0], [1.0, 3.0, 2.0]) == 2.0


def test_forces_that_differ_end_it(monkeypatch: pytest.MonkeyPatch) -> None:
    right = tactile_path.plain_run

    def doubled(counts: np.ndarray, forces: list[np.ndarray]) -> Timed:
        taken = right(counts, forces)
        forces[:] = [2.0 * force_n for force_n in forces]
        return taken

    monkeypatch.setattr(tactile_path, "plain_run", doubled)
    with pytest.raises(SystemExit, match="the forces on the grip differ"):
        tactile_path.main(EFFORT)


def test_matrices_that_differ_end_it(monkeypatch: pytest.MonkeyPatch) -> None:
    right = sweep.plain_matrix
    monkeypatch.setattr(sweep, "plain_matrix", lambda a, b, c: right(1.001 * a, b, c))
    with pytest.raises(SystemExit, match="the values differ"):
        sweep.main(EFFORT)


@pytest.mark.parametrize(
    ("wrong", "expected"), [("status", "different values"), ("goals", "did not set the goals")]
)
def test_servo_values_that_differ_end_it(
    wrong: str, expected: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    lies = {"status": lambda self: ({}, 0), "goals": lambda self: (0, 0)}
    monkeypatch.setattr(_servo_clients.Sdk, wrong, lies[wrong])
    hosts = {"ServoBus": _servo_clients.Ours, "dynamixel_sdk": _servo_clients.Sdk}
    with _servo_clients.servos() as line_of:
        line_of.set(paced=False)
        with pytest.raises(SystemExit, match=expected):
            servo_bus.compare(line_of, hosts, 1, 2)


def test_a_recogniser_that_changes_its_mind_ends_it(monkeypatch: pytest.MonkeyPatch) -> None:
    calls = iter(range(10_000))
    monkeypatch.setattr(identify, "label_of", lambda recognizer, one: f"{next(calls)}")
    train, test = identify.made(2, 3, 1)
    with pytest.raises(SystemExit, match="names the same grasps differently"):
        identify.compare("made", train, test, 2)


def test_equal_results_go_on() -> None:
    same(True, "nothing")
