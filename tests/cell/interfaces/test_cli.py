"""The command line: its commands, what they write, exit codes; the terminal and its signals."""

import contextlib
import io
import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock, create_autospec

import pytest
from typer.testing import CliRunner

from cell.commissioning.engine import WizardAborted, leave
from cell.commissioning.findings import Finding, ProposedChange, Verdict
from cell.config.file import changed_config, config_text, load_config, schema_text
from cell.config.model import CellConfig
from cell.control.records import GraspRecord
from cell.control.states import CellState
from cell.errors import (
    CellError,
    CellStopped,
    ConfigError,
    ModelError,
    PartInGrip,
    PositionerError,
    RecordingError,
    ReportError,
)
from cell.interfaces.cli import main, session, terminal, terminal as asking
from cell.interfaces.cli.app import app
from cell.interfaces.cli.commands.commission import TerminalDialog
from cell.interfaces.cli.commands.run import result_lines
from cell.interfaces.cli.session import running_cell
from cell.interfaces.cli.signals import stopping
from cell.learning.model import load_model, save_model
from cell.learning.training import train
from cell.recording import sink
from cell.recording.dataset import read_dataset, write_dataset
from cell.recording.reader import read_recording
from cell.recording.recorder import Recorder
from cell.report.confusion import score
from cell.runtime.main_job import teach_and_identify
from recognition.recognizer import UNKNOWN
from recognition.recognizers.level_check import LevelCheckTrainer
from tests.cell.cells import REAL, call, once, plain_grasp, quick_config, small_config
from tests.fuzz.harness import Clock
from tests.marks import LONG
from tests.values import raising
from tests.waiting import LIMIT_S, until

RUNNER = CliRunner()
EXAMPLES = Path(__file__).parents[3] / "config"
REAL_FAULT = "--fault can.off is for the simulated cell"
BUILT_IN = "cell: the built-in simulated cell; --config FILE names another"
LEFT_IGNORED = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""Signals that the program ignores when it ends."""


@pytest.fixture
def fail(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Iterator[Any]:
    """Return what runs the program as a shell does, to its exit code, and returns its complaint."""
    before = {number: signal.getsignal(number) for number in LEFT_IGNORED}

    def run(*arguments: object, code: int = 1) -> str:
        monkeypatch.setattr(sys, "argv", ["tactile-cell", *(str(a) for a in arguments)])
        with pytest.raises(SystemExit) as caught:
            main()
        assert caught.value.code == code
        return " ".join("".join(capsys.readouterr()).split())

    yield run
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.fixture(scope="session")
def small_text(taught: Any) -> str:
    """Text of the small cell's config file."""
    return config_text(changed_config(taught.config, {"recording.directory": "FOLDER"}))


@pytest.fixture
def config(small_text: str, tmp_path: Path) -> Path:
    """Config file of the small cell, with its folder in the test's."""
    path = tmp_path / "cell.yaml"
    path.write_text(small_text.replace("FOLDER", str(tmp_path / "out")))
    return path


@pytest.fixture
def quick(tmp_path: Path) -> Path:
    """Config file of a cell without a model that grasps quickly, with its folder in the test's."""
    path, folder = tmp_path / "quick.yaml", str(tmp_path / "out")
    changes = {"recording__directory": folder, "sequence__max_grasps": 1}
    path.write_text(config_text(quick_config(**changes), comments=False))
    return path


@pytest.fixture
def dataset(taught: Any) -> Path:
    return taught.result.model


@pytest.fixture
def model(taught: Any) -> Path:
    return taught.result.model


def read_json(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))


# -- commands on the cell --------------------------------------------------------------------------


@pytest.fixture
def main_job(taught: Any, monkeypatch: pytest.MonkeyPatch) -> Any:
    """The main job in `run`: it returns the result of an earlier one."""
    job = create_autospec(teach_and_identify, return_value=replace(taught.result))
    monkeypatch.setattr("cell.interfaces.cli.commands.run.teach_and_identify", job)
    return job


def test_run_shows_and_writes_what_the_job_returns(quick, tmp_path, main_job, monkeypatch) -> None:
    monkeypatch.setattr("cell.report.page.render_report", str)
    out, report = tmp_path / "elsewhere", tmp_path / "json" / "run.json"
    text = call(
        *("run", "--config", quick, "--object", "ball", "--object", "box", "--teach", 3),
        *("--trials", 1, "--out", out, "--seed", 7, "--json", report),
    )
    ((_, config), asked) = main_job.call_args
    assert (config.seed, asked["folder"].parent) == (7, out)
    assert (asked["labels"], asked["n_teach"], asked["n_trials"]) == (["ball", "box"], 3, 1)
    data = read_json(report)
    assert (data["n_taught"], data["labels"]) == (10, ["ball", "box"])
    assert data["health"]["tactile"]["lost"] == 0
    for name, file in (("report", "report.html"), ("recording", "recording.mcap")):
        assert data[name] == str(asked["folder"] / file)
    for name in ("report", "model"):
        assert Path(data[name]).stat().st_size > 1000
        assert data[name] in text
    assert "This cell, all grasps: " in text


def test_a_report_that_cannot_be_written_does_not_cost_the_result(
    quick, main_job, fail, monkeypatch
) -> None:
    run = "cell.interfaces.cli.commands.run."
    monkeypatch.setattr(f"{run}recorded_report", str)
    monkeypatch.setattr(f"{run}write_report", raising(ReportError("cannot write: no space left")))
    said = fail("run", "-c", quick)
    assert "This cell, all grasps: " in said
    assert said.endswith("error (fault 504): cannot write: no space left")


def test_the_paper_is_put_beside_its_five_objects(taught, capsys) -> None:
    labels = ("box", "ball", "oval", "cylinder", "dumbbell")
    scores = dict.fromkeys(("force_ramp", "level_check"), score("", labels, labels, labels))
    terminal.show(result_lines(replace(taught.result, labels=labels, scores=scores), {}))
    lines = capsys.readouterr().out.splitlines()
    assert "its Table 1): 48 of 50 right" in lines[0]
    assert "  ball: ball 90, cylinder 10" in lines
    # Two answers that are right alike have one table.
    assert sum("5 of 5 right, 0 wrong" in line for line in lines) == 2
    assert lines.count("  ball: ball 1") == 1


@pytest.mark.slow
def test_teach_extends_a_data_set_with_other_poses(quick, tmp_path) -> None:
    path = tmp_path / "d.npz"
    call("teach", "ball", "-n", 1, "-o", path, "-c", quick, "--json", tmp_path / "t.json")
    data = read_json(tmp_path / "t.json")
    assert (data["label"], data["n_grasps"], data["dataset"]) == ("ball", 1, str(path))
    assert len(read_recording(data["recording"]).grasps) == 1
    text = call("teach", "part_7", "--object", "box", "-n", 1, "-o", path, "-c", quick)
    assert "1 grasps of part_7 added" in text
    assert "(1 before)" in text
    assert [grasp.label for grasp in read_dataset(path)] == ["ball", "part_7"]


def test_teach_finds_out_before_the_first_grasp_where_it_cannot_write(
    config, dataset, taught, tmp_path, fail
) -> None:
    out = ("--out", tmp_path / "out")
    assert "must end with .json" in fail("identify", dataset, "--json", dataset, code=2)
    for command in (("teach", "box", "-o"), ("serve", "--save")):
        said = fail(*command, tmp_path / "gone" / "d.npz", "-c", config, *out, code=2)
        assert "make it first" in " ".join(said.split())
    other = tmp_path / "other.npz"
    pads = replace(taught.grasps[0].pads, adc_max=4095)
    write_dataset(other, [replace(grasp, pads=pads) for grasp in taught.grasps])
    said = fail("teach", "box", "-o", other, "-c", config, *out)
    assert "a full scale of 255 instead of 4095" in said
    assert not (tmp_path / "out").exists()


def test_identify_on_the_cell(config, model, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(GraspRecord, "ended", "ended early at 2.5 N")
    text = call(
        *("identify", "-m", model, "--object", "box", "-c", config, "--keep", "when-named"),
        *("--json", tmp_path / "i.json"),
    )
    data = read_json(tmp_path / "i.json")
    assert "(it was box)" in text
    assert (data["label"], data["presented"], data["in_grip"]) == ("box", "box", True)
    assert "the part was kept until the simulated cell ended" in text
    assert set(data["probabilities"]) == {"ball", "box", UNKNOWN}
    assert f"answer: box {terminal.percent(data['probabilities']['box'])}" in text
    low, high = data["interval_mm"]
    size = f"{data['size_mm']:.1f} mm ({low:.1f} to {high:.1f})"
    assert f"; flat, {size}; ended early at 2.5 N\n" in text
    assert read_recording(data["recording"]).results[0]["label"] == "box"


def test_a_job_whose_recording_alone_fails_has_its_answer_and_fails(
    config, model, tmp_path, monkeypatch
) -> None:
    monkeypatch.setattr(sink.os, "fsync", raising(OSError(28, "No space left on device")))
    written = tmp_path / "written.json"
    options = ("-c", str(config), "--json", str(written))
    result = RUNNER.invoke(app, ["identify", "-m", str(model), "--object", "box", *options])
    assert "answer: box" in result.stdout
    assert isinstance(result.exception, RecordingError)
    assert "stopped after" in str(result.exception)
    assert "No space left" in read_json(written)["health"]["recording"]


def test_grasps_that_neither_data_set_nor_recording_has_are_lost_with_a_message(
    quick, tmp_path, monkeypatch
) -> None:
    monkeypatch.setattr(sink.os, "fsync", raising(OSError(28, "No space left on device")))
    monkeypatch.setattr("cell.build.Cell.recording_fault", property(lambda _cell: "it is full"))
    options = ("-o", str(tmp_path / "x.npz"), "-c", str(quick))
    result = RUNNER.invoke(app, ["teach", "box", "-n", "1", *options])
    assert "1 of 1 grasps" not in result.stdout
    said = str(result.exception)
    assert "x.npz: no space left" in said
    assert "grasps that are not saved: 1; " in said
    assert "recording.mcap has stopped, too: free space" in said


def test_the_command_that_lets_a_kept_part_go_is_printed(
    config, model, meddle, monkeypatch
) -> None:
    def pretend(_made: Any) -> None:
        # From here on the command takes its cell for one with real ports.
        monkeypatch.setattr(CellConfig, "simulated", property(lambda _config: False))

    meddle(pretend)
    options = ("-m", model, "-c", config, "--object", "box", "--keep", "always")
    text = " ".join(call("identify", *options).split())
    assert f"the part is kept; to release it: tactile-cell hand release --config {config}" in text


def test_a_recording_is_identified_without_shapes(taught, config, model, tmp_path) -> None:
    recording = taught.result.recording
    config.write_text(config.read_text().replace("shape: true", "shape: false"))
    text = call("identify", recording, "-m", model, "-c", config, "--json", tmp_path / "i.json")
    assert "mm" not in text
    answers = read_json(tmp_path / "i.json")["answers"]
    names = {"grasp", "label", "probability", "unknown", "truth", "shape"}
    assert [set(answer) for answer in answers] == len(answers) * [names]
    assert [answer["grasp"] for answer in answers] == [*range(len(answers))]
    assert {answer["shape"] for answer in answers} == {None}
    assert [answer["truth"] for answer in answers[:10]] == ["ball"] * 5 + ["box"] * 5
    assert text.count("(was ball)") >= 5


def test_release_names_the_cell_and_has_to_be_meant(config, tmp_path, monkeypatch, fail) -> None:
    monkeypatch.chdir(tmp_path)
    for arguments in ((), ("--confirm",)):
        said = fail("hand", "release", *arguments, code=2)
        assert "name the config file of the cell and confirm; nothing was moved" in said
        assert "`tactile-cell hand release --config FILE --confirm`" in said
    Path("tactile-cell.yaml").write_text(config.read_text())
    said = fail("hand", "release", "--confirm", code=2)
    assert "`tactile-cell hand release --config tactile-cell.yaml --confirm`" in said
    assert "`tactile-cell hand clear --config tactile-cell.yaml`" in fail("hand", "clear", code=2)
    said = fail("hand", "release", "-c", config, code=2)
    assert f"`tactile-cell hand release --config {config} --confirm`" in said
    assert call("hand", "release", "-c", config, "--confirm") == (
        "simulated cell: released; the fingers are open; the cell is simulated, no real part was "
        "moved\n"
    )


@pytest.mark.slow
def test_clear_shows_the_servos_and_restarts_them_where_that_is_asked_for(
    quick, fail, tmp_path
) -> None:
    said = fail("hand", "clear", code=2)
    assert "`tactile-cell hand clear --config FILE`" in said
    said = call("hand", "clear", "-c", quick)
    assert said == "".join(f"simulated cell: servo {n} has no torque\n" for n in (1, 2))

    loaded = load_config(quick)
    faulty = tmp_path / "faulty.yaml"
    overloaded = changed_config(loaded, {"simulator.faults": ["servo1.overload"]})
    faulty.write_text(config_text(overloaded))
    said = fail("hand", "clear", "-c", faulty)
    assert "the error lasts" in said
    assert said.endswith(f": tactile-cell hand clear --config {faulty} --reboot")
    said = call("hand", "clear", "--reboot", "-c", faulty)
    assert "servo 1 has no torque (overload)\n" in said
    assert said.endswith("after the reboot servo 1 has no torque\n")

    faulty.write_text(config_text(changed_config(loaded, {"simulator.faults": ["servo2.off"]})))
    said = fail("hand", "clear", "-c", faulty)
    assert "servo 2 does not answer: remove the cause" in said


def test_the_first_line_names_the_cell(config, tmp_path, monkeypatch, capfd) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("cell.interfaces.cli.commands.doctor.examine", lambda *_: iter(()))

    def first_line(*arguments: object) -> str:
        return RUNNER.invoke(app, ["doctor", *map(str, arguments)]).stderr.splitlines()[0]

    assert first_line() == BUILT_IN
    assert first_line("-c", config) == f"cell: simulated cell, simulated ({config})"
    call("config", "init", "--example", "paper-gripper")
    ports = "/dev/ttyUSB0, socketcan can0"
    assert first_line() == f"cell: paper gripper at {ports} (tactile-cell.yaml)"
    Path("tactile-cell.yaml").unlink()
    Path("tactile-cell.yaml").symlink_to("gone.yaml")
    assert "tactile-cell.yaml: No such file" in str(RUNNER.invoke(app, ["doctor"]).exception)


def test_a_terminal_obeys_no_text_of_a_file(tmp_path, capsys, monkeypatch) -> None:
    config = tmp_path / "cell.yaml"
    config.write_text('"\\e[2Jkey": 1\n', encoding="utf-8")
    with pytest.raises(ConfigError) as caught:
        load_config(config)
    for print_one in (
        terminal.print_line,
        terminal.print_error,
        terminal.print_note,
        terminal.print_cell,
    ):
        print_one(f"{caught.value}\r[bold] \u202e\x9b")
    text = "".join(capsys.readouterr())
    assert text.count("\\x1b[2Jkey: unknown key") == 4
    assert text.count("\\r[bold] \\u202e\\x9b") == 4
    assert not set("\x1b\r\u202e\x9b") & set(text)
    monkeypatch.setattr("builtins.input", str)
    assert terminal.ask("place \x1b[2J") == "place \\x1b[2J"


def test_release_and_doctor_need_nobody_who_moves(config) -> None:
    text = config.read_text(encoding="utf-8")
    config.write_text(text.replace("kind: simulated", "kind: callback"), encoding="utf-8")
    assert load_config(config).positioner.kind == "callback"
    call("hand", "release", "-c", config, "--confirm")
    assert "fail" not in call("doctor", "-c", config)


# -- commands over records -------------------------------------------------------------------------


def test_train_writes_a_model(dataset, tmp_path) -> None:
    path = tmp_path / "m.npz"
    text = call(
        *("model", "train", dataset, dataset, "-o", path, "--recognizer", "level_check"),
        *("--json", tmp_path / "t.json"),
    )
    assert "2 objects taught with 20 grasps" in text
    assert load_model(path).trainer_name == "level_check"
    written = read_json(tmp_path / "t.json")
    amount, series = written.pop("notes")
    assert "4 objects (now 2)" in amount
    assert "in one series" in series
    assert written == {
        "model": str(path),
        "recognizer": "level_check",
        "n_grasps": 20,
        "labels": ["ball", "box"],
    }


def test_commands_use_the_model_that_was_trained_last_in_the_folder(
    dataset, config, tmp_path, monkeypatch, fail
) -> None:
    monkeypatch.chdir(tmp_path)
    config.write_text(config.read_text().replace("shape: true", "shape: false"))
    call("model", "train", dataset, "-o", "m.npz", "--recognizer", "level_check")
    result = RUNNER.invoke(app, ["identify", str(dataset), "-c", str(config)])
    assert "the model is m.npz of the last `model train` here" in result.stderr
    assert "grasp    9: " in result.stdout
    Path("m.npz").write_bytes(b"")
    for command in ("identify", "sort", "serve --http 0", "model calibrate --gauge ball -o c.npz"):
        assert "m.npz" in fail(*command.split(), "-c", config)
    Path("m.npz").unlink()
    assert "--model is missing" in fail("identify", "-c", config, code=2)


def test_evaluate_prints_what_is_taken_for_which_object_and_what_is_left_out(
    taught, dataset, tmp_path, monkeypatch
) -> None:
    monkeypatch.setattr(LevelCheckTrainer, "fit", raising(ValueError("no object has a level")))
    ball, others = taught.grasps[0], taught.grasps[1:]
    tested = tmp_path / "tested.npz"
    write_dataset(tested, [replace(ball, label="box"), *others])
    both = ("--recognizer", "force_ramp", "--recognizer", "level_check")
    command = ("model", "evaluate", tested, "--train", dataset, *both, "--fuse", "1", "--fuse", "2")
    command += ("--json", tmp_path / "e.json")
    result = RUNNER.invoke(app, [str(one) for one in command], catch_exceptions=False)
    said = " ".join(result.output.split())
    assert "level_check is left out: no object has a level" in said
    written = read_json(tmp_path / "e.json")
    assert (list(written["left_out"]), written["labels"]) == (["level_check"], ["ball", "box"])
    figures = written["recognizers"]["force_ramp"]
    low, high = figures["interval"]
    assert low <= figures["single_accuracy"] < high
    assert set(figures["fused_accuracy"]) == {"1", "2"}
    assert "tactile only" in said
    assert "nan" not in said
    assert "force_ramp confuses, one grasp each: 1 x box as ball" in said


# -- config, doctor, simulate ----------------------------------------------------------------------


@pytest.mark.slow
def test_config_init_and_check(tmp_path, fail) -> None:
    path = tmp_path / "new.yaml"
    call("config", "init", path)
    assert load_config(path) == CellConfig()
    assert "valid: simulated cell, simulated" in " ".join(call("config", "check", path).split())
    assert (tmp_path / "tactile-cell.schema.json").read_text() == schema_text()
    said = fail("config", "init", path, code=2)
    assert "--force" in said
    call("config", "init", path, "--force")
    path.write_text("gripper:\n  force_max_n: 99\n")
    said = fail("config", "check", path, code=2)
    assert "new.yaml:2" in said
    # Examples are the configs of the repository.
    said = fail("config", "init", path, "--force", "--example", "none", code=2)
    for file in EXAMPLES.glob("*.yaml"):
        assert file.stem in said
    call("config", "init", path, "--force", "--example", "pinch-13x6")
    assert load_config(path) == load_config(EXAMPLES / "pinch-13x6.yaml")


def test_doctor_passes_and_fails(tmp_path, config, fail, monkeypatch) -> None:
    findings = [Finding(what="disk", verdict=Verdict.PASS, text="room", advice="none")]
    monkeypatch.setattr("cell.interfaces.cli.commands.doctor.examine", lambda *_: iter(findings))
    printed = call("doctor", "-c", config, "--json", tmp_path / "d.json")
    assert printed == "pass  disk: room  -> none\n"
    assert read_json(tmp_path / "d.json")["findings"] == [asdict(findings[0])]
    findings[0] = replace(findings[0], verdict=Verdict.FAIL)
    assert "1 of 1 checks failed" in fail("doctor", "-c", config)


def test_simulate_prints_one_line_and_adds_to_the_faults_of_the_config(
    config, tmp_path, monkeypatch
) -> None:
    served: list[tuple[CellConfig, Any]] = []

    def serve(config: CellConfig, *, announce: Callable[..., None], **options: Any) -> None:
        served.append((config, options))
        announce({"servo_port": "/dev/pts/7"})

    monkeypatch.setattr("cell.interfaces.cli.commands.simulate.serve_simulated_cell", serve)
    config.write_text(config.read_text().replace("faults: []", "faults: [unit.stuck@9s]"))
    fault = ("--fault", "can.loss=0.05@2s")
    output = call("simulate", "-c", config, "--out", tmp_path / "sim", "--seed", 11, *fault)
    assert output == '{"servo_port": "/dev/pts/7"}\n'
    ((changed, options),) = served
    assert (changed.seed, changed.simulator.faults) == (11, ("unit.stuck@9s", "can.loss=0.05@2s"))
    assert options == {"folder": tmp_path / "sim", "until_parent_ends": False}


# -- exit codes ------------------------------------------------------------------------------------


@pytest.fixture(scope="session")
def files(tmp_path_factory: Any, taught: Any, small_text: str) -> dict[str, Path]:
    """Files that jobs refuse, and some that they take."""
    folder = tmp_path_factory.mktemp("files")
    names = ("other.npz", "nameless.npz", "empty.mcap", "made.npz", "none.npz")
    paths = {name.split(".")[0]: folder / name for name in names}
    write_dataset(paths["other"], [plain_grasp("a")] * 3)
    write_dataset(paths["nameless"], [plain_grasp("")])
    Recorder(paths["empty"], Clock(), pads=taught.grasps[0].pads).close()
    operated = small_text.replace("kind: simulated\n", "kind: operator\n")
    drawn = "gripper: {{port: simulated}}\nsimulator: {{objects: [{{label: a, shape: '{}'}}]}}\n"
    texts = {
        "config": small_text.replace("FOLDER", str(folder / "out")),
        "meshed": drawn.format("mesh:file=a.stl"),
        "undrawn": drawn.format("sphere:diameter=9"),
        "operated": operated,
    }
    for name, text in texts.items():
        paths[name] = folder / f"{name}.yaml"
        paths[name].write_text(text)
    given = {name: getattr(taught.result, name) for name in ("model", "recording")}
    given["dataset"] = given["model"]
    given["level"] = folder / "level.npz"
    save_model(given["level"], train(taught.grasps, "level_check"), taught.grasps)
    return paths | given | {"real": EXAMPLES / "paper-gripper.yaml"}


@pytest.mark.parametrize(
    ("code", "command", "complaint"),
    [
        (2, "nonsense", "No such command"),
        (2, "run --teach 2", "--teach"),
        (2, "run --object unicorn", "the simulated cell has no object unicorn; it has oval"),
        (2, "run -c {operated}", "name the available objects"),
        (2, "identify -m m.npz --keep perhaps", "--keep"),
        (2, "identify x.npz -m m.npz --keep always", "--keep is for a cell"),
        (2, "identify -m {model} -c {config} --object ..", "label '..' is blank, of dots"),
        (2, f"teach {'x' * 61} -o {{made}} -c {{config}}", "at most 60 characters"),
        (2, "teach ball -o x.txt", "the name of a data set ends in .npz"),
        (2, "model train x.npz -o m", "the name of a model file ends in .npz"),
        (2, "recording recover x.mcap -o y.npz", "the name of a recording ends in .mcap"),
        (2, "model train x.npz -o m.npz --recognizer magic", "no recognizer 'magic' is installed"),
        (2, "model evaluate {dataset} --fuse 1,x", "--fuse"),
        (2, "model evaluate {dataset} --split foo", "chronological:0.6, or series, days or cells"),
        (2, "model evaluate {dataset} --days 2026-99-01", "month must be in 1..12"),
        (1, "recording plot 99 {dataset} -o {made}", "no grasp 99: 10 are selected"),
        (1, "service install -m {other}", "makes a model of it"),
        (2, "serve --listen 0.0.0.0 --modbus 0", "serve.allow is empty"),
        (2, "serve -c {config} --out served", "no interface is open: set serve.http_port"),
        (2, "config check {undrawn}", "as in diameter=6mm"),
        (2, "sort --config {operated}", "--model is missing"),
        (2, "teach ball -o {made} -c {real} --fault can.off", REAL_FAULT),
        (2, "identify x.npz -m m.npz --fault can.off", "leave it out for recorded grasps"),
        (2, "identify --follow -m {model}", "--follow is for recorded grasps"),
        (1, "identify --follow -m {level} {dataset}", "level_check model cannot follow or gauge"),
        (2, "teach x -o {made} --shape sphere:diameter=9mm --fault can.off", "for a drawing"),
        (1, "model train {none} -o {made}", "none.npz"),
        (1, "model train {dataset} {other} -o {made}", "different pads; train a model for each"),
        (1, "model train {nameless} -o {made}", "its 1 grasps have no label"),
        (1, "model train {empty} -o {made}", "has no whole grasp"),
        (1, "doctor --plugins --json {config}/x.json", "cannot be written"),
        (1, "run -c {config} --out {config}", "cannot be made"),
    ],
)
def test_wrong_use_is_two_and_a_failing_job_one(fail, files, code, command, complaint) -> None:
    assert complaint in fail(*command.format(**files).split(), code=code)
    assert not files["made"].exists()


@pytest.mark.parametrize(
    ("extra", "command"),
    [
        ("trimesh: mesh", "teach x -o {made} --shape mesh:file={none}"),
        ("trimesh: mesh", "config check {meshed}"),
        ("fastapi: serve", "serve -c {config} --http 0"),
        ("matplotlib: report", "recording report {recording}"),
        ("jinja2: report", "recording report {recording}"),
    ],
)
def test_a_missing_extra_is_named_with_the_command_that_adds_it(
    fail, files, extra, command, monkeypatch
) -> None:
    package, _, extra = extra.partition(": ")
    users = [f"cell.interfaces.{name}" for name in ("web", "page")]
    for name in list(sys.modules):
        if name.partition(".")[0] == package:
            monkeypatch.setitem(sys.modules, name, None)
        elif name.startswith(tuple(users)):
            monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, package, None)
    said = fail(*command.format(**files).split(), code=2)
    assert f" needs {package}; install this project with its extra `{extra}`: pip install" in said


@pytest.mark.slow
@pytest.mark.parametrize(
    ("number", "left"),
    [
        *((signal.SIGINT, left) for left in (True, False)),
        *(LONG(number, True) for number in (signal.SIGTERM, signal.SIGHUP)),
    ],
)
def test_a_signal_stops_the_job_and_keeps_grip_recording_and_what_was_grasped(
    quick, tmp_path, fail, meddle, *, number, left
) -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)  # as in a terminal, not under nohup
    folder, struck_s = tmp_path / "data", list[float]()
    folder.mkdir()

    def strike() -> None:
        struck_s.append(built[0].simulated.clock.monotonic())
        os.kill(os.getpid(), number)
        until(lambda: built[0].controller.life.interrupted)  # the cell's time stands meanwhile
        if not left:
            folder.rmdir()

    def in_the_third_grasp(made: Any) -> None:
        made.controller.grasp = grasp = Mock(side_effect=made.controller.grasp)
        force_n = made.simulated.world.contact_force_n
        once(made.simulated.clock, lambda: grasp.call_count == 3 and min(force_n()) > 2.0, strike)

    built = meddle(in_the_third_grasp)
    said = fail("teach", "ball", "-n", 20, "-o", folder / "d.npz", "-c", quick)
    signal.signal(signal.SIGHUP, before)
    assert min(built[0].simulated.world.contact_force_n()) > 1.0
    (recording,) = (tmp_path / "out").glob("teach-*/recording.mcap")
    stored = read_recording(recording)
    assert stored.complete
    (held_s,) = (event["t_s"] for event in stored.events if event["kind"] == "held")
    assert 0.0 <= held_s - struck_s[0] <= 0.02
    if left:
        assert "the grip is kept until it is released on purpose. Recording so far: " in said
        assert [grasp.label for grasp in read_dataset(folder / "d.npz")] == ["ball", "ball"]
    else:
        assert "recording.mcap: use it with `tactile-cell model train`" in said


HEAVY = {"numpy", "scipy", "matplotlib", "canopen", "can", "rich", "serial", "joblib"}
"""Not pydantic: newer versions of typer load it themselves."""


@pytest.mark.parametrize(
    ("arguments", "environment"),
    [(["recording", "--help"], {}), ([], {"COMP_WORDS": "tactile-cell hand ", "COMP_CWORD": "2"})],
)
def test_help_and_completion_load_nothing_heavy(arguments, environment) -> None:
    program = (
        "import sys, atexit; atexit.register(lambda: print(*sys.modules, file=sys.stderr));"
        "sys.argv[0] = 'tactile-cell'; from cell.interfaces.cli import main; main()"
    )
    if environment:
        environment = environment | {"_TACTILE_CELL_COMPLETE": "complete_bash"}
    command, env = [sys.executable, "-c", program, *arguments], os.environ | environment
    ended = subprocess.run(command, env=env, capture_output=True, text=True, check=True)
    assert len(ended.stdout) > 3
    loaded = set(ended.stderr.split())
    assert "typer" in loaded
    assert not {name.partition(".")[0] for name in loaded} & HEAVY
    assert not any(name.startswith("cell.config.") for name in loaded)
    assert len(loaded) < 400


def test_an_interrupt_outside_a_sequence_is_one(monkeypatch, fail) -> None:
    monkeypatch.setattr("cell.interfaces.cli.commands.doctor.examine", raising(KeyboardInterrupt()))
    assert fail("doctor") == f"{BUILT_IN} error: interrupted"


def test_without_a_terminal_the_end_of_each_task_is_a_line(capsys) -> None:
    with terminal.progress_bar() as progress:
        progress("teach", 1, 2)
        assert capsys.readouterr().err == ""
        progress("teach", 2, 2)
        assert capsys.readouterr().err == "teach 2/2\n"


def test_progress_and_complaints_end_no_job_when_the_terminal_is_gone(monkeypatch) -> None:
    with open("/dev/full", "w", buffering=1) as full:
        monkeypatch.setattr(sys, "stderr", full)
        terminal.print_error("unheard")
        terminal.print_note("unheard")
        with terminal.progress_bar() as progress:
            for done in range(3):
                progress("task", done, 2)
        monkeypatch.undo()
        with contextlib.suppress(OSError):
            full.close()


@pytest.mark.slow
def test_a_fault_tells_its_number_what_became_of_the_grip_and_where_the_recording_is(
    quick, tmp_path, fail
) -> None:
    report = tmp_path / "run.json"
    options = ("--config", quick, "--out", tmp_path / "out", "--fault", "servos.off@contact+0.3s")
    said = fail("run", *options, "--json", report)
    ended = read_json(report)
    assert (ended["fault_number"], ended["progress"]["label"]) == (102, "ball")
    assert ended["ended_early"].split()[0] in said
    assert "a part may still be gripped" in said
    assert "the grip is kept" not in said
    assert read_recording(ended["recording"]).complete


# -- sort --------------------------------------------------------------------------------------


def test_sort_prints_how_many_parts_lie_where(config, model, tmp_path) -> None:
    report = tmp_path / "sort.json"
    printed = call("sort", "-c", config, "-m", model, "--parts", 1, "--json", report)
    assert "1 parts sorted, 100 % with a name, 0 rejected" in printed
    assert "mistakes: none" in printed
    written = read_json(report)
    assert written["places"] == {"ball": 1, "box": 0, "reject": 0}
    events = [event["text"] for event in read_recording(written["recording"]).events]
    assert "ball at ball" in events
    page = Path(written["recording"]).with_name("report.html")
    assert call("recording", "report", written["recording"]) == f"report: {page}\n"
    assert "released at: ball" in page.read_text("utf-8")


# -- The terminal: the wizard's questions, and what ends a sequence from outside -------------------


CHOICES = {"a": "the first\n  | |", "b": "the second [x]"}
WRITE = ProposedChange(where="servo 1", what="id (7)", before="1", after="2", undo="by --restore")


@pytest.fixture
def typed(monkeypatch: pytest.MonkeyPatch) -> Callable[..., TerminalDialog]:
    def type_in(*lines: str) -> TerminalDialog:
        monkeypatch.setattr(sys, "stdin", io.StringIO("".join(f"{line}\n" for line in lines)))
        return TerminalDialog()

    return type_in


@pytest.mark.parametrize(
    ("lines", "answer"), [(["2"], "b"), (["b"], "b"), ([""], "a"), (["7", "x", "1"], "a")]
)
def test_choices_are_taken_by_number_name_or_enter(typed, lines, answer, capsys) -> None:
    assert typed(*lines).choose("q", "Which?", CHOICES, "a") == answer
    assert "  1  the first (Enter)\n  | |\n  2  the second" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("lines", "default", "answer"),
    [(["10,5"], None, 10.5), (["", "0", "nan", "ten", "99"], None, 99.0), ([""], 7.0, 7.0)],
)
def test_a_number_has_a_range_and_may_have_a_default(typed, lines, default, answer) -> None:
    assert typed(*lines).number("q", "?", (1, 100, "mm"), default) == answer


def test_a_refused_restore_names_the_command_that_asks_again(tmp_path, monkeypatch) -> None:
    restore = "cell.interfaces.cli.commands.commission.restore_servos"
    monkeypatch.setattr(restore, lambda *_bench, **_begin: leave("refused"))
    options = ["--restore", "--servo-port", "/dev/ttyUSB0"]
    ended = CliRunner().invoke(app, ["commission", str(tmp_path), *options])
    assert ended.exit_code == 1
    assert "left: nothing was written; the same command shows the changes again" in ended.stderr


@pytest.mark.parametrize("lines", [["q"], []])
def test_q_and_the_end_of_input_leave(typed, lines) -> None:
    with pytest.raises(WizardAborted, match="the same command without --redo continues"):
        typed(*lines).choose("q", "?", CHOICES)


def test_writes_are_shown_and_refused_unless_yes_is_typed(typed, capsys) -> None:
    zero = replace(WRITE, what="drive_mode (10)", before="0", after="4")
    typed("", "maybe", "y").approve([WRITE, zero])
    text = capsys.readouterr().out
    assert "servo 1: id (7): 1 -> 2" in text
    assert "servo 1: drive_mode (10): 0 -> 4" in text
    assert text.count("undo: by --restore") == 1
    for refusal in ("n", "q"):
        with pytest.raises(WizardAborted):
            typed(refusal).approve([WRITE])


# -- What ends a sequence from outside -------------------------------------------------------------


def run(program: str) -> subprocess.CompletedProcess[bytes]:
    return subprocess.run(
        [sys.executable, "-c", program], capture_output=True, timeout=LIMIT_S, check=False
    )


def test_the_death_of_the_parent_stops_once(monkeypatch, undo) -> None:
    # As in a terminal, wherever the tests were started.
    undo.callback(signal.signal, signal.SIGHUP, signal.signal(signal.SIGHUP, signal.SIG_DFL))
    stopped, calls = threading.Event(), list[int]()

    def stop() -> None:
        calls.append(1)
        stopped.set()

    with stopping(stop):
        assert not stopped.wait(0.15)
        monkeypatch.setattr(os, "getppid", lambda: 1)
        assert stopped.wait(LIMIT_S)
    assert calls == [1]


def test_a_program_under_nohup_outlives_terminal_and_parent(monkeypatch, undo) -> None:
    undo.callback(signal.signal, signal.SIGHUP, signal.signal(signal.SIGHUP, signal.SIG_IGN))
    calls: list[int] = []
    with stopping(lambda: calls.append(1)):
        monkeypatch.setattr(os, "getppid", lambda: 1)
        signal.raise_signal(signal.SIGHUP)
        assert "parent" not in [thread.name for thread in threading.enumerate()]
        assert calls == []
        signal.raise_signal(signal.SIGTERM)
        assert calls == [1]
    assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN


@pytest.mark.parametrize("hanging", ["time.sleep(60)", "sum(range(1 << 40))"])
def test_a_second_signal_leaves_little_time_to_close_files(hanging) -> None:
    program = f"""
import os, signal, time
from cell.interfaces.cli import signals
signals.END_WITHIN_S = 0.05
with signals.stopping(lambda: None, left='; the grip is kept'):
    try:
        os.kill(os.getpid(), signal.SIGTERM)
        os.kill(os.getpid(), signal.SIGTERM)
    except KeyboardInterrupt:
        print('closing', flush=True)
        {hanging}
"""
    ended = run(program)
    assert (ended.returncode, ended.stdout) == (1, b"closing\n")
    assert b"error: interrupted; the grip is kept\n" in ended.stderr


@pytest.mark.slow
def test_a_signal_while_the_program_ends_leaves_its_exit_code() -> None:
    program = """
import atexit, os, signal, sys
from cell.interfaces.cli import main
signal.signal(signal.SIGHUP, signal.SIG_DFL)
for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
    atexit.register(os.kill, os.getpid(), number)
sys.argv = ['tactile-cell', 'nonsense']
main()
"""
    ended = run(program)
    assert ended.returncode == 2
    assert b"No such command" in ended.stderr
    assert b"Traceback" not in ended.stderr


def test_a_third_signal_does_not_cut_off_what_the_second_leaves_time_for() -> None:
    program = """
import os, signal, time
from cell.interfaces.cli import signals
signals.END_WITHIN_S = 30.0
try:
    with signals.stopping(lambda: None):
        try:
            os.kill(os.getpid(), signal.SIGINT)
            os.kill(os.getpid(), signal.SIGINT)
        finally:
            os.kill(os.getpid(), signal.SIGTERM)
            print('closed', flush=True)
except KeyboardInterrupt:
    os.kill(os.getpid(), signal.SIGINT)
    print('told', flush=True)
"""
    ended = run(program)
    assert (ended.returncode, ended.stdout) == (0, b"closed\ntold\n")


def test_a_stop_does_not_wait_for_whoever_moves_the_object(make_bench) -> None:
    answered = threading.Event()
    bench = make_bench(
        small_config(positioner__kind="operator"),
        ask=lambda _text: "" if answered.wait(LIMIT_S) else "q",
    )
    bench.controller.start()
    clock = bench.simulated.clock
    end_s = clock.monotonic() + 1.0
    clock.on_advance.append(
        lambda now_s: bench.controller.life.cancel() if end_s <= now_s < end_s + 0.01 else None
    )
    with pytest.raises(CellStopped, match="the fingers are open"):
        bench.controller.moves.present("ball")
    assert bench.controller.life.state is CellState.IDLE
    with pytest.raises(PositionerError, match="was abandoned and still runs"):
        bench.controller.moves.present("ball")
    answered.set()
    for thread in threading.enumerate():
        if thread.name == "positioner":
            thread.join(LIMIT_S)
    bench.controller.moves.present("ball")


def test_an_answer_from_a_pipe_is_read_line_by_line(monkeypatch, capsys) -> None:
    out_of, into = os.pipe()
    os.write(into, b"done\nq\n")
    os.close(into)
    with os.fdopen(out_of) as pipe:
        monkeypatch.setattr(asking.sys, "stdin", pipe)
        monkeypatch.setattr(asking.sys, "__stdin__", pipe)
        assert [asking.ask("next? "), asking.ask("next? ")] == ["done", "q"]
        with pytest.raises(EOFError):
            asking.ask("next? ")
    assert capsys.readouterr().out == "next? " * 3


# -- The cell of a command: what is left when its recording ends early -----------------------------


@pytest.mark.parametrize(
    ("in_the_job", "at_the_end", "told"),
    [
        (None, [RecordingError], ""),
        (None, [ModelError], "ModelError"),
        (None, [ModelError, RecordingError], "RecordingError"),
        (RecordingError, [], "RecordingError"),
        (ModelError, [RecordingError], "ModelError"),  # the first error of a job ends it
        (PartInGrip, [], "PartInGrip"),
    ],
)
def test_a_job_ends_early_unless_its_recording_alone_fails_at_the_end(
    tmp_path, monkeypatch, in_the_job, at_the_end, told
) -> None:
    def fail(errors: list[type[Exception]]) -> None:
        if errors:
            try:
                fail(errors[:-1])
            finally:
                raise errors[-1](errors[-1].__name__)

    plugin = Mock(recording_path="r.mcap")
    plugin.close = lambda: fail(at_the_end)
    plugin.cell.health.return_value = {}
    plugin.cell.controller.hand.notes, plugin.cell.realtime = (), False
    plugin.cell.controller.zeroing.note = ""
    plugin.status.return_value = Mock(state="IDLE")
    monkeypatch.setattr(session, "TactileCellPlugin", lambda *_arguments, **_options: plugin)
    ended, file = "", tmp_path / "a cell.yaml"
    try:
        with running_cell(small_config(**REAL), "run", tmp_path, config_file=file, json_file=None):
            if in_the_job is not None:
                raise in_the_job(in_the_job.__name__)
    except CellError as error:
        ended, left, release = str(error).split("\n")
        kept = "nothing was moved" if in_the_job is PartInGrip else "the grip is kept"
        assert left == f"{kept}; recording so far: r.mcap"
        assert release.endswith(f"t: tactile-cell hand release --config '{file}' --confirm")
    assert ended == told
