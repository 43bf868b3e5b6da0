"""The law from counts to newtons of the wizard: loads on both pads, and the factor that is set."""

import numpy as np
import pytest

from cell.checks.findings import Finding, Verdict
from cell.commissioning.engine import StepFailed
from cell.commissioning.law import LawStep, fit_factor, fit_table, judge_law, table_parts
from cell.config.tactile import TactileConfig
from simulator.world.taxels import SensorLaw
from tactile.layout import paper_layout
from tactile.sensor.calibration import TableCalibration
from tests.cell.commissioning.conftest import MakeStand, Stand

LOADS_N = (2.0, 5.0, 8.0)
STEP = LawStep()


@pytest.fixture
def paper(stand: MakeStand) -> MakeStand:
    """Return what makes a cell with the pads of the paper, whose law is that of foam."""

    def make(*faults: str) -> Stand:
        one = stand(*faults, layout=paper_layout())
        one.knows(tactile__layout="paper", tactile__tare_frames=60)
        return one

    return make


@pytest.mark.slow
def test_a_law_that_is_right_passes_and_changes_nothing(paper: MakeStand) -> None:
    finding = paper().passes(STEP)
    assert finding.settings == {}
    assert finding.values["factor"] == pytest.approx(1.0, abs=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("felt", [0.8, 1.25])
def test_a_law_that_is_off_is_named_and_set_right(paper: MakeStand, felt: float) -> None:
    finding = paper(f"taxels.force_gain={felt}").run(STEP)
    assert finding.status is Verdict.WARN
    assert "The law was 2" in finding.lines[-1]
    gain = finding.settings["tactile.calibration.gain"]
    assert gain == pytest.approx(1.0 / felt, rel=0.06)
    assert finding.corrected == [finding.lines[-1]]
    assert f"tactile.calibration.gain was 1, is now {gain:.3g}" in finding.lines[-1]


@pytest.mark.slow
def test_loads_that_were_typed_outlast_an_error_of_the_unit(paper: MakeStand) -> None:
    one = paper()

    def upset() -> None:
        one.does("load finger1.inner 510")()
        one.cell.inject("unit.emergency=0xFF02")

    failed = one.run(STEP, **{"pads_law.1.2": upset})
    assert failed.status is Verdict.FAIL
    assert "emergency" in failed.lines[-1]
    one.bench.found = {"pads_law": failed.values}
    found = one.passes(STEP)
    assert one.person.script.asked == ["pads_law.with", "pads_law.1.2", "pads_law.1.3"]
    assert "4 loads are kept" in one.person.script.text
    assert [len(loads) for loads in found.values["loads_n"]] == [3, 3]
    # A law that was judged begins anew.
    one.bench.found = {"pads_law": found.values}
    one.passes(STEP)
    assert len(one.person.script.asked) == 7


@pytest.mark.slow
def test_a_linear_law_is_set_by_its_force_of_a_count(stand: MakeStand) -> None:
    one = stand(law=SensorLaw(full_scale_n=0.0012 * 4095))
    law = {"kind": "linear", "force_per_count_n": 0.001}
    one.knows(tactile__tare_frames=60, tactile__calibration=law)
    finding = one.run(STEP)
    assert finding.status is Verdict.WARN, finding.lines
    found = finding.settings["tactile.calibration.force_per_count_n"]
    assert found == pytest.approx(0.0012, rel=0.05)


def test_without_a_scale_the_forces_are_unchecked(stand: MakeStand) -> None:
    finding = stand().run(STEP, pads_law__with="skip")
    assert finding.status is Verdict.WARN
    assert "not checked" in finding.lines[0]


@pytest.mark.parametrize(
    ("loads", "named"),
    [
        ([[(1.0, 1.0), (3.0, 0.4), (6.0, 6.0)]] * 2, "do not fit one law"),
        ([[(1.0, 2.0), (3.0, 3.0), (6.0, 3.6)]] * 2, "do not fit one law"),
        ([[(1.0, 0.0), (3.0, 0.0)]] * 2, "No law can be found: the pads show no force"),
    ],
)
def test_loads_that_are_no_law_fail(loads, named: str) -> None:
    with pytest.raises(StepFailed, match=named):
        judge_law(TactileConfig(), loads, notes := Finding())
    assert not notes.settings


def test_pads_that_differ_are_a_word_to_the_operator() -> None:
    one, other = [[(n, factor * n) for n in LOADS_N] for factor in (1.1, 0.92)]
    judge_law(TactileConfig(), [one, other], finding := Finding())
    assert finding.status is Verdict.WARN
    assert "The pads differ: factor 0.91 on finger 0, 1.09 on finger 1" in finding.lines[1]
    assert finding.settings["tactile.pad_gains"] == pytest.approx([0.9255, 1.1065], abs=0.001)


def test_the_factor_is_the_least_squares_one() -> None:
    fit = fit_factor([1.0, 2.0, 3.0], [0.8, 1.6, 2.4])
    assert (fit.factor, fit.residual_n) == pytest.approx((1.25, 0.0))
    with pytest.raises(ValueError, match="2 loads and 1"):
        fit_factor([1.0, 2.0], [1.0])


TRUE = TableCalibration((16.0, 32.0, 64.0, 128.0), (0.05, 0.12, 0.31, 0.9), 255)
"""Law of pads whose taxels are less sensitive the more they are pressed."""


def pressed(force_n: float, n_taxels: int) -> tuple[float, ...]:
    """Return a load as a wrong straight law shows it, spread unevenly over taxels."""
    share = np.linspace(1.0, 2.0, n_taxels)
    counts = np.zeros(384)
    counts[:n_taxels] = TRUE.counts(force_n * share / share.sum())
    return force_n, 0.01 * float(counts.sum()), *table_parts(counts, 255)


def test_loads_that_bend_make_a_table() -> None:
    loads = [[pressed(force_n, n) for force_n, n in ((2.0, 4), (5.0, 25), (8.0, 9))]] * 2
    tactile = TactileConfig.model_validate(
        {"layout": "flexitac_12x32", "calibration": {"kind": "linear", "force_per_count_n": 0.01}}
    )
    judge_law(tactile, loads, finding := Finding(), 255)
    law = finding.settings["tactile.calibration"]
    assert law["kind"] == "table"
    found = TableCalibration(tuple(law["counts"]), tuple(law["force_n"]), 255)
    counts = np.array([40.0, 80.0, 110.0])
    assert found.force_n(counts) == pytest.approx(TRUE.force_n(counts), rel=0.15)
    assert finding.values["table_residual_n"] < 0.1
    # The same loads under the table are right.
    shown = [[(load[0], load[0], *load[2:]) for load in one] for one in loads]
    judge_law(tactile, shown, again := Finding(), 255)
    assert not again.settings


def test_a_table_needs_loads_that_rise_with_the_counts() -> None:
    with pytest.raises(ValueError, match="show no counts"):
        fit_table([1.0, 2.0], [[0.0] * 9] * 2, 255)
