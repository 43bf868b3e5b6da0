"""Constants of the force loop: each has an origin, and the benchmark changes one at a time."""

import importlib.util
from pathlib import Path

import pytest

from benchmarks.performance.sensitivity import (
    FACTORS,
    ORIGINS,
    PAGE,
    ROOT,
    Constant,
    Scaled,
    constants,
    moved,
    table,
)

pytestmark = pytest.mark.no_cover

REMEDY = "a constant has changed: correct its row, or benchmarks.performance.sensitivity --page"


def test_each_constant_has_a_text_and_a_known_origin() -> None:
    found = constants()
    assert len(found) > 100
    assert [one.key for one in found if not one.text or one.origin not in ORIGINS] == []


def test_the_page_has_each_constant_of_today() -> None:
    page = PAGE.read_text(encoding="utf-8")
    rows = [row for row in table(constants(), {}) if row.startswith("| `")]
    starts = [row.removesuffix("|  |  |") for row in rows]
    assert [start for start in starts if start not in page] == [], REMEDY
    assert sum(row.startswith("| `") for row in page.splitlines()) == len(rows), REMEDY


@pytest.mark.parametrize(
    ("module", "name", "factor", "wanted"),
    [
        ("timing", "LATE_SHARE", 2.0, 1.0),
        ("timing", "_DECADES", 4.0 / 3.0, 9),
        ("loop", "_FREEZE_AT", 2.0 / 3.0, 1),
        ("control.modes", "_CORRECTED_N", 2.0, {False: 0.1, True: 0.2}),
        ("supervision.doubt", "RUN_M", 2.0, 6e-4),
        ("supervision.doubt", "_RUN_M_S", 2.0, 0.016),
    ],
)
def test_one_constant_is_another_from_the_import_on(module, name, factor, wanted) -> None:
    whole = f"gripper.force.{module}"
    path = ROOT.joinpath(*whole.split(".")).with_suffix(".py")
    spec = importlib.util.spec_from_loader(whole, Scaled(whole, str(path), name, factor))
    other = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(other)
    assert getattr(other, name) == pytest.approx(wanted)


def test_figures_move_by_a_quarter_by_two_ramps_or_by_more_than_the_scatter_of_forces() -> None:
    base = {"hold met of 8": 8.0, "late, in s": 0.1, "error in N": 0.01}
    assert moved(base, base | {"error in N": 0.05}) == []
    assert moved(base, base | {"error in N": 0.07}) == ["error in N 0.01 to 0.07"]
    assert moved(base, base | {"hold met of 8": 7.0, "late, in s": 0.12, "error in N": 0.02}) == []
    assert moved(base, base | {"hold met of 8": 6.0, "late, in s": float("inf")}) == [
        "hold met of 8 8 to 6",
        "late, in s 0.1 to inf",
    ]
    assert moved(base, "ValueError: x") == ["ends with ValueError: x"]


def test_a_row_has_the_figures_of_both_values() -> None:
    one = Constant(module="gripper.force.a.b", name="_C_S", value="1", text="Time.", origin="tuned")
    effects = {("a.b._C_S", FACTORS[0]): ["x 1 to 2"], ("a.b._C_S", FACTORS[1]): []}
    assert table([one], effects)[-2] == "| `b._C_S` | `1` | Time. | tuned | x 1 to 2 | - |"
    assert Path(PAGE).name == "force-constants.md"
