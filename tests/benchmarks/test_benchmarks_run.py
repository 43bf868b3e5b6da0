"""Each benchmark runs to its end and prints its ratios: a figure that is quoted can be measured.

How fast anything is, is not tested here. Each benchmark itself ends with an error where its
alternatives do not give the same.
"""

import importlib
import sys
from pathlib import Path

import pytest

import benchmarks
from benchmarks import __main__ as command
from benchmarks._measure import in_turns, ratio, same
from benchmarks.performance import identify

pytestmark = pytest.mark.no_cover  # to count lines takes as long again as to run them

EFFORT = 0.01
MODULES = command.modules()
TESTED_ELSEWHERE = {"reproduction"}
"""`test_paper` prints the study that it has made, which takes longest of all."""


@pytest.mark.long
@pytest.mark.parametrize("name", sorted(MODULES.keys() - TESTED_ELSEWHERE))
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
    assert {"identify", "reproduction"} <= set(MODULES)
    monkeypatch.setattr(sys, "argv", ["benchmarks", "nothing"])
    with pytest.raises(SystemExit, match=", ".join(MODULES)):
        command.main()


def test_alternatives_take_turns_and_begin_in_turn() -> None:
    order: list[str] = []
    found = in_turns({name: lambda n=name: order.append(n) or n for name in "abc"}, 2)
    assert "".join(order) == "abcbca"
    assert found == {"a": ["a", "a"], "b": ["b", "b"], "c": ["c", "c"]}
    assert ratio([1.0, 9.0, 4.0], [1.0, 3.0, 2.0]) == 2.0


def test_a_recogniser_that_changes_its_mind_ends_it(monkeypatch: pytest.MonkeyPatch) -> None:
    calls = iter(range(10_000))
    monkeypatch.setattr(identify, "label_of", lambda recognizer, one: f"{next(calls)}")
    train, test = identify.made(2, 3, 1)
    with pytest.raises(SystemExit, match="names the same grasps differently"):
        identify.compare("made", train, test, 2)


def test_equal_results_go_on() -> None:
    same(True, "nothing")
