"""The engine of the wizard: left at any moment and taken up again, redone, finished; its record."""

import json
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from cell.checks.findings import STORE_NAME, Finding, ProposedChange, Verdict
from cell.commissioning.bench import Bench
from cell.commissioning.engine import CONFIG_NAME, Dialog, Engine, Question, Step, WizardAborted
from cell.commissioning.figures import curves, element, pads
from cell.commissioning.record import RECORD_NAME, write_record
from cell.config.file import changed_config, config_text, load_config
from cell.data.formats import COMMISSIONING, write_json
from cell.errors import CellError, ConfigError
from cell.interfaces.cli.app import app
from gripper.errors import PortLost
from tactile.layout import pinch_layout
from tests.cell.commissioning.hands import Script

REAL = {"gripper.port": "/dev/ttyUSB0", "tactile.interface": "socketcan", "tactile.channel": "can0"}


@dataclass
class Asking(Step):
    """A step that asks one question."""

    key: str
    needs: tuple[str, ...] = ()
    settings: dict[str, Any] = field(default_factory=dict)
    verdicts: list[Verdict] = field(default_factory=lambda: [Verdict.PASS])
    figures: dict[str, Any] = field(default_factory=dict)
    title: str = "a step"
    purpose: str = "asks"
    undo: str = "nothing to undo"
    seen: list[dict[str, Any]] = field(default_factory=list)

    def run(self, bench: Bench, dialog: Dialog, notes: Finding) -> None:
        self.seen.append(dict(bench.settings))
        answer = dialog.ask(Question(key=f"{self.key}.q", text="?", default="yes"))
        notes.status = self.verdicts.pop(0) if len(self.verdicts) > 1 else self.verdicts[0]
        notes.fact(f"{self.key}: {answer}")
        notes.values["answer"] = answer
        notes.settings |= self.settings
        notes.figures |= self.figures
        if self.settings:
            notes.fact(f"{self.key} was wrong", corrected=True)


def steps() -> list[Asking]:
    return [
        Asking("ports", settings=REAL),
        Asking("servos", needs=("ports",), settings={"gripper.baud_rate": 2000000}),
        Asking("unit", needs=("ports",)),
        Asking("force", needs=("servos", "unit")),
    ]


def test_leaving_keeps_what_was_found_and_the_next_run_goes_on_there(tmp_path: Path) -> None:
    first = Script(leave_at=["unit.q"])
    with pytest.raises(WizardAborted):
        Engine(steps(), Bench(tmp_path)).run(first)
    assert first.asked == ["ports.q", "servos.q", "unit.q"]
    assert list(json.loads((tmp_path / STORE_NAME).read_text())["steps"]) == ["ports", "servos"]
    assert not (tmp_path / CONFIG_NAME).exists()

    again, walk = Script(), steps()
    files = Engine(walk, Bench(tmp_path)).run(again)
    assert again.asked == ["unit.q", "force.q"]
    assert walk[2].seen == [{**REAL, "gripper.baud_rate": 2000000}]
    assert tmp_path / CONFIG_NAME in files
    config = load_config(tmp_path / CONFIG_NAME)
    assert (config.gripper.port, config.gripper.baud_rate) == ("/dev/ttyUSB0", 2000000)
    assert Engine(steps(), Bench(tmp_path)).run(third := Script())
    assert third.asked == []


def test_a_step_that_is_left_keeps_the_values_that_it_has_found(tmp_path: Path) -> None:
    class Typing(Asking):
        def run(self, bench: Bench, dialog: Dialog, notes: Finding) -> None:
            typed = list(bench.found.get(self.key, {}).get("typed", ()))
            notes.settings |= REAL
            while len(typed) < 3:
                dialog.ask(Question(key=f"load{len(typed)}", text="?", default=1.0))
                typed.append(1.0)
                notes.values["typed"] = typed

    first = Script(leave_at=["load2"])
    with pytest.raises(WizardAborted):
        Engine([Typing("law")], Bench(tmp_path)).run(first)
    engine = Engine([Typing("law")], bench := Bench(tmp_path))
    assert not engine.done(engine.steps[0])
    assert (bench.found, bench.settings) == ({"law": {"typed": [1.0, 1.0]}}, {})
    engine.run(again := Script())
    assert again.asked == ["load2"]


def test_what_was_wrong_is_one_list_of_all_steps(tmp_path: Path) -> None:
    with pytest.raises(WizardAborted):
        Engine(steps(), Bench(tmp_path)).run(Script(leave_at=["unit.q"]))
    engine = Engine(steps(), Bench(tmp_path))
    engine.run(Script())
    assert engine.corrected == ["ports was wrong", "servos was wrong"]
    engine.redo("servos")
    assert engine.corrected == ["ports was wrong"]


@pytest.mark.slow
def test_redo_forgets_a_step_and_all_that_need_it(tmp_path: Path) -> None:
    engine = Engine(steps(), Bench(tmp_path))
    engine.run(Script())
    assert engine.redo("servos") == ("servos", "force")
    assert list(Engine(steps(), Bench(tmp_path)).findings) == ["ports", "unit"]
    Engine(steps(), Bench(tmp_path)).run(again := Script())
    assert again.asked == ["servos.q", "force.q"]
    with pytest.raises(CellError, match="the steps are ports, servos, unit, force"):
        engine.redo("wheels")


def test_a_failed_step_runs_again_or_is_left(tmp_path: Path) -> None:
    step = Asking("ports", settings=REAL, verdicts=[Verdict.FAIL, Verdict.FAIL, Verdict.WARN])
    with pytest.raises(WizardAborted, match="tactile-cell commission"):
        Engine([step], Bench(tmp_path)).run(Script({"ports.again": ["again", "leave"]}))
    engine = Engine([step], Bench(tmp_path))
    assert engine.findings["ports"].status is Verdict.FAIL
    engine.run(script := Script())
    assert script.asked == ["ports.q"]
    assert engine.findings["ports"].status is Verdict.WARN


def test_a_line_that_is_lost_fails_the_step_which_keeps_what_it_has_found(tmp_path: Path) -> None:
    class Lost(Asking):
        def run(self, bench: Bench, dialog: Dialog, notes: Finding) -> None:
            notes.fact("the port opens")
            notes.figures["force"] = {"x": [1.0]}
            notes.settings |= REAL
            raise PortLost("the cable is out")

    with pytest.raises(WizardAborted):
        Engine([Lost("ports")], Bench(tmp_path)).run(script := Script({"ports.again": "leave"}))
    finding = script.findings["ports"]
    assert finding.lines == ["the port opens", "the cable is out"]
    assert (finding.figures, finding.settings) == ({"force": {"x": [1.0]}}, {})


def test_figures_are_kept_as_numbers(tmp_path: Path) -> None:
    figures = {"zero": {"x": [1, 2]}}
    step = Asking("pads", settings=REAL, figures=figures)
    engine = Engine([step], Bench(tmp_path), finish=lambda e: [e.path])
    assert engine.run(Script())[-1] == tmp_path / STORE_NAME
    assert Engine([step], Bench(tmp_path)).findings["pads"].figures == figures


@pytest.mark.parametrize("content", ["", "{}", "[1]", {"steps": 3}])
def test_a_damaged_store_is_named_and_kept(tmp_path: Path, content: Any) -> None:
    path = tmp_path / STORE_NAME
    if isinstance(content, str):
        path.write_text(content)
    else:
        write_json(path, COMMISSIONING, content, error=CellError)
    text = path.read_text()
    with pytest.raises(CellError, match="move it away"):
        Engine(steps(), Bench(tmp_path))
    assert path.read_text() == text


def test_steps_stand_behind_those_they_need(tmp_path: Path) -> None:
    with pytest.raises(CellError, match="step force needs servos"):
        Engine([Asking("force", needs=("servos",))], Bench(tmp_path))


@pytest.mark.slow
def test_the_command_goes_on_where_it_was_left_and_writes_config_and_record(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cell.commissioning.walk.all_steps", steps)
    command = ["commission", str(tmp_path), "--servo-port", "/dev/ttyUSB7", "--can", "socketcan:c"]
    left = CliRunner().invoke(app, command, input="\nq\n")
    assert (left.exit_code, (tmp_path / CONFIG_NAME).exists()) == (1, False)
    done = CliRunner().invoke(app, command, input="\n\n\n")
    assert done.exit_code == 0, done.output
    assert f"{tmp_path}/{RECORD_NAME}" in done.stdout
    assert load_config(tmp_path / CONFIG_NAME).gripper.baud_rate == 2000000


@pytest.mark.slow
def test_what_users_wrote_into_the_config_stays(tmp_path: Path) -> None:
    Engine(steps(), Bench(tmp_path)).run(Script())
    path = tmp_path / CONFIG_NAME
    config = load_config(path)
    assert config.positioner.kind == "operator"
    changes = {"gripper.force_max_n": 20.0, "name": "cell 7", "gripper.baud_rate": 4000000}
    path.write_text(config_text(changed_config(config, changes)))
    again = Engine(steps(), Bench(tmp_path))
    again.redo("servos")
    again.run(Script())
    found = load_config(path)
    assert (found.gripper.force_max_n, found.name) == (20.0, "cell 7")
    # What a step has found is as it was found.
    assert found.gripper.baud_rate == 2000000


def test_sections_are_there_before_the_config_is_whole(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.settings = {"gripper.port": "/dev/ttyUSB0", "gripper.slip.drop_n": 0.5}
    assert bench.gripper(baud_rate=2000000).slip.drop_n == 0.5
    assert bench.tactile(node_id=9).node_id == 9
    with pytest.raises(ConfigError, match="must both be"):
        _ = bench.config
    with pytest.raises(ConfigError, match="baud_rate"):
        bench.gripper(baud_rate=3)


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
    assert 'alt="Ramp"' in page
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
    assert element(RAMP).count("<img") == 1
    assert element(NOISE).count("<svg") == 2
