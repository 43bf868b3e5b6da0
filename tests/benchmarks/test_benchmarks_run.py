"""Each benchmark runs to its end and prints figures: what is quoted can be measured.

How fast anything is, is not tested here. Each benchmark itself ends with an error where its
alternatives do not give the same.
"""

import importlib
import sys

import pytest

from benchmarks import __main__ as command
from benchmarks._measure import same, share
from benchmarks.performance import soak

pytestmark = pytest.mark.no_cover  # to count lines takes as long again as to run them

EFFORT = 0.01
MODULES = command.modules()
OTHERWISE = {*command.WITH_DATA, "soak"}
"""Some need data, and the soak is run for a moment."""


@pytest.mark.long
@pytest.mark.timeout(600)
@pytest.mark.parametrize("name", sorted(MODULES.keys() - OTHERWISE))
def test_it_prints_its_figures(name, capsys, monkeypatch, tmp_path) -> None:
    monkeypatch.delenv("TACTILE_CELL_DATA", raising=False)
    monkeypatch.chdir(tmp_path)
    importlib.import_module(MODULES[name]).main(EFFORT)
    printed = capsys.readouterr().out
    assert printed.startswith("compared")
    assert len(printed.splitlines()) > 1
    assert "nan" not in printed


@pytest.mark.long
@pytest.mark.timeout(600)
def test_a_short_soak_leaves_no_file_and_no_thread(capsys, monkeypatch) -> None:
    kept = {"descriptors": 0.01, "threads": 0.01}
    monkeypatch.setattr(soak, "LIMITS", dict.fromkeys(soak.LIMITS, kept))
    monkeypatch.setattr(soak, "REST_S", 0.5)
    soak.main(grasps=6, connects=40, hours=0.05, starts=2)
    printed = capsys.readouterr().out
    assert printed.count("descriptors grow by 0.0000 each") == 4


@pytest.mark.parametrize(("leak", "found"), [(0.0, 0), (1.0, 1)])
def test_a_leak_is_found_and_one_step_of_the_allocator_is_none(leak, found) -> None:
    samples = [{"done": 20 * i, "objects": 2000 * (i > 9) + 20 * i * leak} for i in range(50)]
    assert len(soak.judge(samples, {"objects": 0.5})) == found


def test_the_command_names_what_there_is(monkeypatch) -> None:
    assert {"identify", "reproduction"} <= set(MODULES)
    monkeypatch.setattr(sys, "argv", ["benchmarks", "nothing"])
    with pytest.raises(SystemExit, match=", ".join(MODULES)):
        command.main()


def test_results_that_should_be_equal_end_it_where_they_are_not() -> None:
    same(True, "nothing")
    with pytest.raises(SystemExit, match="the figures mean nothing: one more"):
        same(False, "one more")


def test_a_share_has_the_interval_of_its_trials() -> None:
    assert share(336, 342) == "98.2 % (96.2 to 99.2)"
    assert share(3 * 10, 3 * 20, times=3) == "50.0 % (29.9 to 70.1)"
    assert share(0, 0) == "0.0 % (0.0 to 100.0)"
