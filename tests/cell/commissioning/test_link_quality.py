"""Quality of the lines: sound ones pass, what is lost or late is named."""

from pathlib import Path

import pytest

from cell.commissioning.bench import Bench
from cell.commissioning.engine import Finding, Verdict, carry_out
from cell.commissioning.link_quality import LinkQualityStep
from simulator.cell import SimulatedCell
from simulator.settings import SimulatorSettings
from tactile.layout import pinch_layout
from tests.cell.commissioning.script import Script, SimulatedLines

BENCH = {
    "gripper.port": "/dev/ttyUSB0",
    "tactile.interface": "socketcan",
    "tactile.channel": "can0",
    "tactile.layout": "pinch",
}


def watched(tmp_path: Path, *faults: str, alone: bool = False) -> Finding:
    with SimulatedCell(SimulatorSettings(layout=pinch_layout())) as cell:
        bench = Bench(tmp_path, SimulatedLines(cell))
        bench.settings = BENCH
        bench.found = {"unit": {"gripper_alone": alone}}
        for fault in faults:
            cell.inject(fault)
        return carry_out(LinkQualityStep(duration_s=2.5), bench, Script())


def test_sound_lines_pass(tmp_path: Path) -> None:
    finding = watched(tmp_path)
    assert finding.status is Verdict.PASS, finding.lines
    assert finding.values["periods"] == 500
    assert finding.values["lost_frames"] == finding.values["retries"] == 0
    assert finding.values["forces"] > 450
    (figure,) = finding.figures.values()
    assert len(figure["x"]) == 2
    assert max(figure["series"]["answer of the servos"]) < 5.0


@pytest.mark.parametrize(
    ("fault", "named"),
    [
        ("can.lose_next=20@1s", "The CAN bus loses messages"),
        ("unit.forces_lost=0.02", "The CAN bus loses messages"),
        ("servos.loss=0.02", "The servos' line loses answers"),
    ],
)
def test_what_is_lost_or_late_is_named(tmp_path: Path, fault: str, named: str) -> None:
    finding = watched(tmp_path, fault)
    assert finding.status is Verdict.WARN, finding.lines
    assert named in "\n".join(finding.lines[3:])


@pytest.mark.parametrize(
    ("fault", "named"),
    [
        ("can.loss=0.003@0.6s", "of the last 50 frames"),
        ("unit.forces_each=5", "ms late, allowed are 15 ms"),
        ("unit.off@0.5s", "no force message"),
        ("servos.unplugged@0.5s", "the servo line is gone"),
    ],
)
def test_a_line_that_fails_ends_the_step(tmp_path: Path, fault: str, named: str) -> None:
    finding = watched(tmp_path, fault)
    assert finding.status is Verdict.FAIL
    assert named in finding.lines[0]


def test_a_gripper_without_pads_has_one_line(tmp_path: Path) -> None:
    finding = watched(tmp_path, "unit.off", alone=True)
    assert finding.status is Verdict.PASS, finding.lines
    assert len(finding.lines) == 2
