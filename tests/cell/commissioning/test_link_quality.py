"""Quality of the lines: sound ones pass, with and without pads."""

from cell.commissioning.link_quality import LinkQualityStep
from tests.cell.commissioning.conftest import MakeStand

STEP = LinkQualityStep(duration_s=2.5)


def test_sound_lines_pass(stand: MakeStand) -> None:
    finding = stand().passes(STEP)
    assert finding.values["periods"] == 500
    assert finding.values["lost_frames"] == finding.values["retries"] == 0
    assert finding.values["forces"] > 450
    (figure,) = finding.figures.values()
    assert len(figure["x"]) == 2
    assert max(figure["series"]["answer of the servos"]) < 5.0


def test_a_gripper_without_pads_has_one_line(stand: MakeStand) -> None:
    one = stand("unit.off")
    one.bench.found = {"unit": {"gripper_alone": True}}
    finding = one.passes(STEP)
    assert len(finding.lines) == 2
