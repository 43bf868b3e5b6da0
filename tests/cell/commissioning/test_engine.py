"""The engine of the wizard: left at any moment and taken up again, redone, finished; its record."""

import json
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from statistics import median
from typing import Any

import pytest
from typer.testing import CliRunner

from cell.commissioning.bench import Bench
from cell.commissioning.engine import (
    CONFIG_NAME,
    RECORD_NAME,
    RESUME,
    Dialog,
    Engine,
    Step,
    WizardAborted,
)
from cell.commissioning.findings import STORE_NAME, Finding, Notes, ProposedChange, Verdict
from cell.commissioning.walk import all_steps
from cell.config.file import changed_config, config_text, load_config
from cell.config.model import CellConfig
from cell.errors import CellError, ConfigError
from cell.interfaces.cli.app import app
from cell.simulation import simulator_settings
from gripper.errors import PortLost
from simulator.cell import SimulatedCell
from tactile.layout import PadMount
from tests.cell.commissioning.hands import Person, Script, SimulatedLines

Run = Callable[[Bench, Dialog, Notes], None]

REAL = {"gripper.port": "/dev/ttyUSB0", "tactile.interface": "socketcan", "tactile.channel": "can0"}


@dataclass
class Asking:
    """The run of a step that asks one question."""

    key: str
    settings: dict[str, Any] = field(default_factory=dict)
    verdicts: list[Verdict] = field(default_factory=lambda: [Verdict.PASS])
    seen: list[dict[str, Any]] = field(default_factory=list)

    def __call__(self, bench: Bench, dialog: Dialog, notes: Notes) -> None:
        self.seen.append(dict(bench.settings))
        answer = dialog.choose(f"{self.key}.q", "?", {"yes": "yes"}, "yes")
        verdict = self.verdicts.pop(0) if len(self.verdicts) > 1 else self.verdicts[0]
        notes.findings.append(Finding(text=f"{self.key}: {answer}", verdict=verdict))
        notes.values["answer"] = answer
        notes.settings |= self.settings
        if self.settings:
            notes.fact(f"{self.key} was wrong", corrected=True)


def step(key: str, run: Run | None = None, needs: tuple[str, ...] = (), **asking: Any) -> Step:
    """Return a step that asks, or does something else."""
    run = run or Asking(key, **asking)
    return Step(run, key, "a step", needs)


def steps() -> list[Step]:
    return [
        step("ports", settings=REAL),
        step("servos", needs=("ports",), settings={"gripper.baud_rate": 2000000}),
        step("unit", needs=("ports",)),
        step("force", needs=("servos", "unit")),
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
    assert walk[2].run.seen == [{**REAL, "gripper.baud_rate": 2000000}]
    assert tmp_path / CONFIG_NAME in files
    config = load_config(tmp_path / CONFIG_NAME)
    assert (config.gripper.port, config.gripper.baud_rate) == ("/dev/ttyUSB0", 2000000)
    assert Engine(steps(), Bench(tmp_path)).run(third := Script())
    assert third.asked == []


def test_redo_forgets_a_step_and_all_that_need_it_and_what_they_corrected(tmp_path: Path) -> None:
    engine = Engine(steps(), Bench(tmp_path))
    engine.run(Script())
    assert engine.corrected == ["ports was wrong", "servos was wrong"]
    assert engine.redo("servos") == ("servos", "force")
    again = Engine(steps(), Bench(tmp_path))
    assert (list(again.notes), again.corrected) == (["ports", "unit"], ["ports was wrong"])
    again.run(script := Script())
    assert script.asked == ["servos.q", "force.q"]
    with pytest.raises(CellError, match="the steps are ports, servos, unit, force"):
        engine.redo("wheels")


def test_a_failed_step_runs_again_or_is_left(tmp_path: Path) -> None:
    ports = step("ports", settings=REAL, verdicts=[Verdict.FAIL, Verdict.FAIL, Verdict.WARN])
    failed = Script(leave_at=["ports.again"])
    with pytest.raises(WizardAborted):
        Engine([ports], Bench(tmp_path)).run(failed)
    assert failed.asked == ["ports.q", "ports.again"]
    engine = Engine([ports], Bench(tmp_path))
    assert engine.notes["ports"].status is Verdict.FAIL
    engine.run(script := Script())
    assert script.asked == ["ports.q", "ports.again", "ports.q"]
    assert engine.notes["ports"].status is Verdict.WARN


def test_a_line_that_is_lost_fails_the_step_which_keeps_what_it_has_found(tmp_path: Path) -> None:
    def lost(_bench: Bench, _dialog: Dialog, notes: Notes) -> None:
        notes.fact("the port opens")
        notes.values["force_n"] = 1.0
        notes.settings |= REAL
        raise PortLost("the cable is out")

    with pytest.raises(WizardAborted):
        Engine([step("ports", lost)], Bench(tmp_path)).run(
            script := Script(leave_at=["ports.again"])
        )
    finding = script.findings["ports"]
    assert finding.lines == ["the port opens", "the cable is out"]
    assert (finding.values, finding.settings) == ({"force_n": 1.0}, {})


@pytest.mark.parametrize("text", ["", "{}", "[1]"])
def test_a_damaged_store_is_named_and_kept(tmp_path: Path, text: str) -> None:
    path = tmp_path / STORE_NAME
    path.write_text(text)
    with pytest.raises(CellError, match="move it away"):
        Engine(steps(), Bench(tmp_path))
    assert path.read_text() == text


def test_steps_stand_behind_those_they_need() -> None:
    keys = [one.key for one in all_steps()]
    for number, one in enumerate(all_steps()):
        assert set(one.needs) <= set(keys[:number])


@pytest.mark.slow
def test_the_command_goes_on_where_it_was_left_and_writes_config_and_record(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cell.interfaces.cli.commands.commission.all_steps", steps)
    command = ["commission", str(tmp_path), "--servo-port", "/dev/ttyUSB7", "--can", "socketcan:c"]
    left = CliRunner().invoke(app, command, input="\nq\n")
    assert (left.exit_code, (tmp_path / CONFIG_NAME).exists()) == (1, False)
    assert left.output.count(RESUME) == 1
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
    config_after = load_config(path)
    assert (config_after.gripper.force_max_n, config_after.name) == (20.0, "cell 7")
    # What a step has found is as it was found.
    assert config_after.gripper.baud_rate == 2000000


def test_sections_are_there_before_the_config_is_whole(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.settings = {"gripper.port": "/dev/ttyUSB0", "gripper.slip.drop_n": 0.5}
    assert bench.gripper(baud_rate=2000000).slip.drop_n == 0.5
    assert bench.tactile(node_id=9).node_id == 9
    with pytest.raises(ConfigError, match="must all be"):
        _ = bench.config
    with pytest.raises(ConfigError, match="baud_rate"):
        bench.gripper(baud_rate=3)


WRITE = ProposedChange(
    where="servo 1", what="ID (7)", before="1", after="2", undo="write the old one back"
)


def test_the_record_has_steps_values_writes_and_a_place_to_sign(tmp_path: Path) -> None:
    def write(bench: Bench, dialog: Dialog, notes: Notes) -> None:
        dialog.approve([WRITE])
        servo = {"model": "XM430-W350", "firmware": 52}
        notes.values |= {"servos": [servo, servo], "zeros": list(range(50))}
        Asking("servos", settings=REAL)(bench, dialog, notes)

    engine = Engine([step("servos", write), step("unit")], Bench(tmp_path))
    for place in ("servos.q", "unit.q"):
        with pytest.raises(WizardAborted):
            engine.run(Script(leave_at=[place]))
    assert engine.record().count("not done") == 1
    page = engine.run(Script())[-1].read_text("utf-8")
    # Approved twice: the step was left after the first time.
    assert page.count("servo 1: ID (7): 1 -> 2; undo: write the old one back") == 2
    assert "## Errors found and corrected\n\n- servos was wrong" in page
    assert '- servos: [{"model": "XM430-W350", "firmware": 52}, {' in page
    assert '- gripper.port: "/dev/ttyUSB0"' in page
    assert "zeros" not in page
    assert page.endswith("signature:\n")


# -- The whole wizard on simulated cells in virtual time: from the box to the first force ----------


EXCHANGED = (PadMount(pad=0, sent_as=1), PadMount(pad=1, sent_as=0))


CONFIGS = Path(__file__).parents[3] / "config"


@pytest.mark.long
@pytest.mark.parametrize(
    ("preset", "sensor"),
    [("rh-p12-rn", "flexitac"), ("open-parallel-gripper", "uskin"), ("rh-p12-rn", "unit")],
)
def test_a_gripper_preset_is_brought_up_from_the_box(preset, sensor, tmp_path, monkeypatch) -> None:
    # A gripper preset with the pads of another preset, or those of the default cell.
    pads = CellConfig() if sensor == "unit" else load_config(CONFIGS / f"{sensor}.yaml")
    base = load_config(CONFIGS / f"{preset}.yaml").model_copy(update={"tactile": pads.tactile})
    # Boards have exchanged pads and another law than the preset.
    boards = sensor != "unit"
    settings = replace(
        simulator_settings(base),
        faults=("servo1.factory", *["taxels.force_gain=0.7"] * boards),
        mounts=EXCHANGED if sensor == "uskin" else (),
        aperture_m=0.016,
    )
    given = {"gripper.port": "/dev/ttyUSB0"}
    ports: tuple[str, ...] = ("/dev/ttyUSB0",)
    if sensor == "flexitac":
        ports = (*ports, "/dev/ttyACM1", "/dev/ttyACM0")
        by_path = "/dev/serial/by-path/usb-0:{}".format
        monkeypatch.setattr("cell.commissioning.unit.lasting_name", lambda port: by_path(port[-1]))
    else:
        given |= {"tactile.interface": "socketcan", "tactile.channel": "can0"}
    with SimulatedCell(settings) as cell:
        person = Person(cell, {r"With which force may it be": ("", "")})
        bench = Bench(tmp_path, SimulatedLines(cell, ports), given=given, base=base)
        Engine(all_steps(), bench).run(person.script)
        (servo,) = cell.devices.servo_bus.servos
        assert servo.registers.get("torque_enable") == 0
    findings = person.script.findings
    assert {key: one.lines for key, one in findings.items() if one.status is Verdict.FAIL} == {}
    config = load_config(tmp_path / CONFIG_NAME)
    (wanted,), (now,) = base.gripper.servos, config.gripper.servos
    assert (now.model, now.direction) == (wanted.model, wanted.direction)
    if boards:
        said = "\n".join(line for one in findings.values() for line in one.lines)
        mounts = tuple(PadMount(**mount.model_dump()) for mount in config.tactile.mounting)
        assert mounts == EXCHANGED
    if sensor == "flexitac":
        assert "named by their USB sockets: leave them" in said
        assert config.tactile.serial_ports == (by_path(1), by_path(0))
    # The median: a push on the ramp may pass the held force for some periods.
    asked_n, held_n, _ = findings["first_force"].values["asked_held_peak_n"][-1]
    pressed_n = [force_n for force_n in person.pressed_n if force_n > 0.5 * asked_n]
    assert median(pressed_n) == pytest.approx(held_n, abs=1.0)


@pytest.mark.long
def test_the_tutorial_shows_what_is_printed() -> None:
    """A cell of wrong hardware, from the box to the first force."""
    from docs.tools.transcript import TRANSCRIPT, transcript

    _, stored = TRANSCRIPT.read_text("utf-8").split("\n", 1)
    assert transcript().split() == stored.split()
