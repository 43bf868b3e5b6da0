"""The record of a commissioning: what was found, written and drawn, in one file."""

import re
from pathlib import Path

import numpy as np
import pytest

from cell.checks.findings import Finding, ProposedChange
from cell.commissioning.bench import Bench
from cell.commissioning.engine import Dialog, Engine, WizardAborted
from cell.commissioning.figures import curves, pads, svg
from cell.commissioning.record import RECORD_NAME, write_record
from tactile.layout import pinch_layout
from tests.cell.commissioning.script import Script
from tests.cell.commissioning.test_engine import REAL, Asking

WRITE = ProposedChange(
    where="servo 1", what="ID (7)", before="1", after="2 <b>", undo="write the old one back"
)
RAMP = curves(
    "Ramp",
    np.linspace(0.0, 2.0, 1500),
    {"asked": np.linspace(0.0, 1.0, 1500), "measured": [np.nan] * 1500},
    x_label="time / s",
    y_label="force / N",
    limits={"cap": 1.0},
)
LAYOUT = pinch_layout()
NOISE = pads("Noise of each taxel", LAYOUT, np.arange(LAYOUT.n_taxels) / 100, unit="counts")


class Writing(Asking):
    """A step that shows a write, then asks."""

    def run(self, bench: Bench, dialog: Dialog, notes: Finding) -> None:
        dialog.approve([WRITE])
        super().run(bench, dialog, notes)


@pytest.mark.slow
def test_the_record_has_steps_writes_pictures_and_a_place_to_sign(tmp_path: Path) -> None:
    pads_step = Asking("pads", figures={"ramp": RAMP, "noise": NOISE})
    walk = [Writing("servos", settings=REAL), pads_step]
    engine = Engine(walk, Bench(tmp_path), finish=write_record)
    with pytest.raises(WizardAborted):
        engine.run(Script(leave_at=["servos.q"]))
    files = Engine(walk, Bench(tmp_path), finish=write_record).run(Script())
    assert files[-1] == tmp_path / RECORD_NAME
    page = files[-1].read_text("utf-8")
    # approved twice, as the step was left after the first time
    assert page.count("<td>ID (7)</td><td>1</td><td>2 &lt;b&gt;</td>") == 2
    assert page.count('<svg class="pad"') == 2
    assert 'aria-label="finger1.inner: 0.78 to 1.55 counts"' in page
    assert 'aria-label="Ramp"' in page
    assert "Signature" in page
    assert '<h2>Errors found and corrected</h2>\n<div class="card"><p>servos was wrong' in page
    assert "<dt><code>gripper.port</code></dt><dd>/dev/ttyUSB0</dd>" in page
    assert not re.search(r"<script|https?://(?!www\.w3\.org)", page)


def test_the_record_of_a_commissioning_that_is_not_done_says_so(tmp_path: Path) -> None:
    engine = Engine([Asking("ports", settings=REAL), Asking("unit")], Bench(tmp_path))
    with pytest.raises(WizardAborted):
        engine.run(Script(leave_at=["unit.q"]))
    (path,) = write_record(engine)
    assert "not done" in path.read_text("utf-8")


def test_values_that_name_hardware_stand_at_the_top(tmp_path: Path) -> None:
    class Servos(Asking):
        def run(self, bench: Bench, dialog: Dialog, notes: Finding) -> None:
            servo = {"model": "XM430-W350", "firmware": 52}
            notes.values |= {"servos": [servo, servo], "zeros": list(range(50))}
            notes.settings |= REAL

    engine = Engine([Servos("servos")], Bench(tmp_path), finish=write_record)
    page = engine.run(Script())[-1].read_text("utf-8")
    head = page[: page.index("<h2>Steps")]
    assert "<dt>servos: servos.1.firmware</dt><dd>52</dd>" in head
    assert "zeros" not in page


def test_a_long_curve_is_thinned_and_a_gap_stays_one() -> None:
    assert len(RAMP["x"]) <= 600
    assert set(RAMP["series"]["measured"]) == {None}
    assert svg(RAMP, "a").count("<svg") == 1
    assert svg(NOISE, "b").count("<svg") == 2
