"""The pads of the wizard: at rest, and pressed by a fingertip; what is wrong is named and set."""

from dataclasses import replace

import numpy as np
import pytest

from cell.commissioning.engine import StepFailed
from cell.commissioning.findings import Notes, Verdict
from cell.commissioning.pads import (
    LAW,
    PADS_AT_REST,
    PADS_PRESSED,
    fit_table,
    judge_law,
    judge_rest,
    table_parts,
)
from cell.config.tactile import TactileConfig
from simulator.can.control_unit import ControlUnitSettings
from simulator.world.taxels import SensorLaw
from tactile.layout import PadMount, paper_layout, pinch_layout
from tactile.sensor.calibration import LinearCalibration, TableCalibration
from tactile.sensor.settings import SensorSettings
from tests.cell.commissioning.conftest import MakeStand
from tests.marks import LONG
from tests.tactile.conftest import counts_of

REST, PRESSED = PADS_AT_REST, PADS_PRESSED


@pytest.mark.parametrize("layout", [pinch_layout(), paper_layout()])
def test_sound_pads_pass_without_a_word_at_rest_and_pressed(make_stand, layout) -> None:
    stand = make_stand(layout=layout)
    stand.knows(tactile__layout=layout.name)
    finding = stand.passes(REST)
    assert len(finding.lines) == 1
    assert finding.settings == {"tactile.board_serial_numbers": [1, 2]}
    assert stand.passes(PRESSED).settings == {"tactile.mounting": []}
    assert stand.person.script.asked == ["pads_pressed.press"] * layout.n_pads


def test_boards_that_cannot_be_told_apart_are_a_word_to_the_operator(make_stand) -> None:
    finding = make_stand(unit=ControlUnitSettings(boards=(0, 0))).run(REST)
    assert finding.status is Verdict.WARN
    assert "press each pad after every work" in "\n".join(finding.lines)
    assert finding.settings == {"tactile.board_serial_numbers": None}


TURNED = [PadMount(pad=p, sent_as=p, rows_mirrored=True, columns_mirrored=True) for p in (0, 1)]
EXCHANGED = [PadMount(pad=0, sent_as=1), PadMount(pad=1, sent_as=0)]
BOTH = [replace(pad, rows_mirrored=True, columns_mirrored=True) for pad in EXCHANGED]
ROWS = [PadMount(pad=1, sent_as=1, rows_mirrored=True)]
COLUMNS = [PadMount(pad=0, sent_as=0, columns_mirrored=True)]


@pytest.mark.parametrize(
    ("mounts", "named"),
    [
        (EXCHANGED, "finger0.inner in that of finger1.inner, finger1.inner in"),
        (BOTH, "finger0.inner in that of finger1.inner, finger1.inner in"),
        (TURNED[:1], "finger0.inner is turned by 180 degrees"),
        (ROWS, "The rows of finger1.inner run the other way"),
        (COLUMNS, "The columns of finger0.inner run the other way"),
    ],
)
def test_pads_that_sit_otherwise_are_found_named_and_set(make_stand, mounts, named) -> None:
    finding = make_stand(mounts=mounts).run(PRESSED)
    assert finding.status is Verdict.WARN
    assert named in "\n".join(finding.lines)
    set_mounts = [PadMount(**mount) for mount in finding.settings["tactile.mounting"]]
    assert set_mounts == mounts


def test_a_dead_pad_is_named_and_fails_the_step(stand) -> None:
    finding = stand.run(PRESSED, pads_pressed__press=[stand.person.does("lift"), "skip", None])
    assert finding.status is Verdict.FAIL
    assert "finger0.inner was not found" in finding.lines[-1]
    assert "No pad shows a fingertip" in stand.person.script.text
    assert finding.settings == {}


def test_the_wrong_pad_or_its_middle_is_asked_for_again(stand) -> None:
    wrong = [stand.person.does(f"press finger{number}.inner") for number in (0, 1)]
    stand.passes(PRESSED, pads_pressed__press=[None, *wrong, None])
    assert stand.person.script.asked == ["pads_pressed.press"] * 4
    assert "The patch is where finger0.inner was found" in stand.person.script.text
    assert "in the middle of the pad" in stand.person.script.text


@pytest.mark.parametrize(
    ("noises", "force_per_count_n", "status", "named"),
    [
        ((20.0, 20.0), 1e-4, Verdict.PASS, ""),
        ((10.0, 60.0), 1e-4, Verdict.WARN, "finger1.inner is noisy: "),
        ((10.0, 60.0), 2e-3, Verdict.FAIL, "The force of finger1.inner at rest varies by 0."),
    ],
)
def test_pads_of_much_noise_are_named(noises, force_per_count_n, status, named) -> None:
    layout, generator = pinch_layout(), np.random.default_rng(0)
    frames = generator.normal(250.0, np.repeat(noises, 78), (30, 156)).astype(np.uint16)
    law, notes = LinearCalibration(force_per_count_n, layout.adc_max), Notes()
    judge_rest(layout, law, frames, notes, limits=SensorSettings(), contact_force_n=0.3)
    assert notes.status is status, notes.lines
    assert named in "\n".join(notes.lines)


# -- The law from counts to newtons: loads on both pads, and the factor that is set ----------------


LOADS_N = (2.0, 5.0, 8.0)


@pytest.mark.parametrize("measured", [1.0, 0.8, LONG(1.25)])
def test_the_law_of_the_foam_is_right_or_named_and_set_right(make_stand, measured) -> None:
    stand = make_stand(f"taxels.force_gain={measured}", layout=paper_layout())
    stand.knows(tactile__layout="paper", tactile__tare_frames=60)
    finding = stand.run(LAW)
    if measured == 1.0:
        assert (finding.status, finding.settings) == (Verdict.PASS, {})
        assert finding.values["factor"] == pytest.approx(1.0, abs=0.05)
        return
    assert finding.status is Verdict.WARN
    assert "The law was 2" in finding.lines[-1]
    gain = finding.settings["tactile.calibration.gain"]
    assert gain == pytest.approx(1.0 / measured, rel=0.06)
    assert finding.corrected == [finding.lines[-1]]
    assert f"tactile.calibration.gain was 1, is now {gain:.3g}" in finding.lines[-1]


def test_a_linear_law_is_set_by_its_force_of_a_count(make_stand: MakeStand) -> None:
    stand = make_stand(law=SensorLaw(full_scale_n=0.0012 * 4095))
    law = {"kind": "linear", "force_per_count_n": 0.001}
    stand.knows(tactile__tare_frames=60, tactile__calibration=law)
    finding = stand.run(LAW)
    assert finding.status is Verdict.WARN, finding.lines
    force_per_count_n = finding.settings["tactile.calibration.force_per_count_n"]
    assert force_per_count_n == pytest.approx(0.0012, rel=0.05)


def test_without_a_scale_the_forces_are_unchecked(make_stand: MakeStand) -> None:
    finding = make_stand().run(LAW, pads_law__with="skip")
    assert finding.status is Verdict.WARN
    assert "not checked" in finding.lines[0]


@pytest.mark.parametrize(
    ("loads", "named"),
    [
        ([[(1.0, 1.0), (3.0, 0.4), (6.0, 6.0)]] * 2, "do not fit one law"),
        ([[(1.0, 2.0), (3.0, 3.0), (6.0, 3.6)]] * 2, "do not fit one law"),
        ([[(1.0, 0.0), (3.0, 0.0)]] * 2, "the middle of each pad: the pads show no force"),
    ],
)
def test_loads_that_are_no_law_fail(loads, named: str) -> None:
    with pytest.raises(StepFailed, match=named):
        judge_law(TactileConfig(), loads, notes := Notes())
    assert not notes.settings


def test_pads_that_differ_are_a_word_to_the_operator() -> None:
    stand, other = [[(n, factor * n) for n in LOADS_N] for factor in (1.1, 0.92)]
    judge_law(TactileConfig(), [stand, other], finding := Notes())
    assert finding.status is Verdict.WARN
    assert "The pads differ: factor 0.91 on finger 0, 1.09 on finger 1" in finding.lines[1]
    assert finding.settings["tactile.pad_gains"] == pytest.approx([0.9255, 1.1065], abs=0.001)


TRUE = TableCalibration((16.0, 32.0, 64.0, 128.0), (0.05, 0.12, 0.31, 0.9), 255)
"""Law of pads whose taxels are less sensitive the more they are pressed."""


def pressed(force_n: float, n_taxels: int) -> tuple[float, ...]:
    """Return a load as a wrong straight law shows it, spread unevenly over taxels."""
    share = np.linspace(1.0, 2.0, n_taxels)
    counts = np.zeros(384)
    counts[:n_taxels] = counts_of(TRUE, force_n * share / share.sum())
    return force_n, 0.01 * float(counts.sum()), *table_parts(counts, 255)


def test_loads_that_bend_make_a_table() -> None:
    loads = [[pressed(force_n, n) for force_n, n in ((2.0, 4), (5.0, 25), (8.0, 9))]] * 2
    tactile = TactileConfig.model_validate(
        {"layout": "flexitac_12x32", "calibration": {"kind": "linear", "force_per_count_n": 0.01}}
    )
    judge_law(tactile, loads, finding := Notes(), 255)
    law = finding.settings["tactile.calibration"]
    assert law["kind"] == "table"
    table = TableCalibration(tuple(law["counts"]), tuple(law["force_n"]), 255)
    counts = np.array([40.0, 80.0, 110.0])
    assert table.force_n(counts) == pytest.approx(TRUE.force_n(counts), rel=0.15)
    assert finding.values["table_residual_n"] < 0.1
    # The same loads under the table are right.
    levers = [[(load[0], load[0], *load[2:]) for load in finger] for finger in loads]
    judge_law(tactile, levers, again := Notes(), 255)
    assert not again.settings


def test_a_table_needs_loads_that_rise_with_the_counts() -> None:
    with pytest.raises(ValueError, match="show no counts"):
        fit_table([1.0, 2.0], [[0.0] * 9] * 2, 255)
