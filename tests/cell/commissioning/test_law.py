"""The law from counts to newtons of the wizard: loads on both pads, and the factor that is set."""

from pathlib import Path
from typing import Any

import pytest

from cell.commissioning.bench import Bench
from cell.commissioning.engine import Finding, Notes, StepFailed, Verdict, carry_out
from cell.commissioning.law import GRAVITY_N_KG, LawStep, fit_factor, judge_law
from cell.config.tactile import TactileConfig
from simulator.cell import SimulatedCell
from simulator.settings import SimulatorSettings
from simulator.world.taxels import SensorLaw
from tactile.layout import paper_layout, pinch_layout
from tests.cell.commissioning.script import Script, SimulatedLines

LOADS_N = (2.0, 5.0, 8.0)


def weighed(
    tmp_path: Path, *faults: str, settings: dict[str, Any], **cell_settings: Any
) -> Finding:
    """Run the step with a person who presses with exact forces, and types what a scale shows."""
    with SimulatedCell(SimulatorSettings(faults=faults, **cell_settings)) as cell:
        bench = Bench(tmp_path, SimulatedLines(cell))
        bench.settings = {
            "tactile.interface": "socketcan",
            "tactile.channel": "can0",
            "tactile.tare_frames": 60,
        } | settings
        world, layout = cell.devices.physical, cell.settings.layout

        def press(finger: int, force_n: float) -> Any:
            def reply() -> float:
                world.press(layout.gripping_pads[finger], 0.0, 0.0, force_n)
                return force_n / GRAVITY_N_KG * 1e3

            return reply

        script = Script(
            {
                f"pads_law.{finger}.{number}": press(finger, force_n)
                for finger in (0, 1)
                for number, force_n in enumerate(LOADS_N, start=1)
            }
        )
        return carry_out(LawStep(), bench, script)


PAPER: dict[str, Any] = {"layout": paper_layout(), "settings": {"tactile.layout": "paper"}}


def test_a_law_that_is_right_passes_and_changes_nothing(tmp_path: Path) -> None:
    finding = weighed(tmp_path, **PAPER)
    assert finding.status is Verdict.PASS, finding.lines
    assert finding.settings == {}
    assert finding.values["factor"] == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize("felt", [0.8, 1.25])
def test_a_law_that_is_off_is_named_and_set_right(tmp_path: Path, felt: float) -> None:
    finding = weighed(tmp_path, f"taxels.force_gain={felt}", **PAPER)
    assert finding.status is Verdict.WARN
    assert "The law was 2" in finding.lines[-1]
    assert finding.settings["tactile.calibration.gain"] == pytest.approx(1.0 / felt, rel=0.06)


def test_a_linear_law_is_set_by_its_force_of_a_count(tmp_path: Path) -> None:
    law = {"kind": "linear", "force_per_count_n": 0.001}
    finding = weighed(
        tmp_path,
        layout=pinch_layout(),
        law=SensorLaw(full_scale_n=0.0012 * 4095),
        settings={"tactile.layout": "pinch", "tactile.calibration": law},
    )
    assert finding.status is Verdict.WARN, finding.lines
    found = finding.settings["tactile.calibration.force_per_count_n"]
    assert found == pytest.approx(0.0012, rel=0.05)


def test_without_a_scale_the_forces_are_unchecked(tmp_path: Path) -> None:
    finding = carry_out(LawStep(), Bench(tmp_path), Script({"pads_law.with": "skip"}))
    assert finding.status is Verdict.WARN
    assert "not checked" in finding.lines[0]


@pytest.mark.parametrize(
    ("loads", "named"),
    [
        ([[(1.0, 1.0), (3.0, 0.4), (6.0, 6.0)]] * 2, "do not lie on one law"),
        ([[(1.0, 2.0), (3.0, 3.0), (6.0, 3.6)]] * 2, "do not lie on one law"),
        ([[(1.0, 0.0), (3.0, 0.0)]] * 2, "No law can be found: the pads show no force"),
    ],
)
def test_loads_that_are_no_law_fail(loads: Any, named: str) -> None:
    with pytest.raises(StepFailed, match=named):
        judge_law(TactileConfig(), loads, notes := Notes())
    assert not notes.settings


def test_pads_that_differ_are_a_word_to_the_operator() -> None:
    one, other = [[(n, factor * n) for n in LOADS_N] for factor in (1.1, 0.92)]
    judge_law(TactileConfig(), [one, other], finding := Notes())
    assert finding.status is Verdict.WARN
    assert "The pads differ: factor 0.91 on finger 0, 1.09 on finger 1" in finding.lines[1]


def test_the_factor_is_the_least_squares_one() -> None:
    fit = fit_factor([1.0, 2.0, 3.0], [0.8, 1.6, 2.4])
    assert (fit.factor, fit.residual_n) == pytest.approx((1.25, 0.0))
    with pytest.raises(ValueError, match="2 loads and 1"):
        fit_factor([1.0, 2.0], [1.0])
