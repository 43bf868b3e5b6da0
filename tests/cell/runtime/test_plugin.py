"""The plugin as a host program sees it, the thread of its cell with its jobs, and health."""

import gc
import importlib.metadata
import os
import re
import shutil
import signal
import sys
import threading
import time
import weakref
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

from cell.config.file import changed_config
from cell.control.part import Part
from cell.control.plan import Pose
from cell.control.positioner import Destination
from cell.control.states import CellState, Command
from cell.errors import (
    CellStateError,
    CellStopped,
    ConfigError,
    DatasetError,
    ModelError,
    NoPartFound,
    RecordingError,
    RequestRefused,
)
from cell.learning.model import Trained
from cell.learning.taught_model import TaughtModel
from cell.learning.teaching_summary import separation
from cell.recording import retention
from cell.recording.dataset import read_grasps
from cell.recording.reader import read_recording
from cell.runtime.goals import GripGoal, IdentifyGoal, SortGoal, TeachGoal, VerifyGoal, checked_goal
from cell.runtime.health import health_values
from cell.runtime.lease import Lease
from cell.runtime.plugin import TactileCellPlugin
from cell.runtime.tasks import Places, SortAnswer
from cell.runtime.worker import JOB_SILENT_S, CellWorker, Job, JobFailed, JobOutcome, Report
from cell.service.service import open_service
from gripper.errors import ServoFault, VerificationFailed
from recognition.grasp import SelfZero
from recognition.recognizer import UNKNOWN
from tactile.errors import NodeMissing, ZeroDrifted
from tests import blocks
from tests.cell.cells import STRANGE, SURE, Scripted, once, quick_config, small_config
from tests.cell.recording.test_recording import fill_disk_after
from tests.cell.served import LIMIT_S, done, grip_n, until
from tests.fuzz.harness import Clock
from tests.values import raising


@pytest.fixture(scope="module")
def plugin_class() -> Any:
    """The class that a host finds by the entry point."""
    (entry,) = importlib.metadata.entry_points(group="robot_cell.plugins", name="tactile_cell")
    return entry.load()


# -- jobs --------------------------------------------------------------------------------------


def test_a_teaching_with_too_few_grasps_says_so_and_keeps_them(make_plugin: Any) -> None:
    plugin = make_plugin(quick_config(recognition__shape=True))
    with pytest.raises(JobFailed, match=r"ABORTED: .*at least 3.*kept for the next") as failed:
        done(plugin, TeachGoal(label="pin", grasps=1, present="ball"))
    assert failed.value.fault_number == 519
    assert (plugin.model.labels, plugin.status().state) == ((), "IDLE")
    plugin.cell.controller.zeros.keep(SelfZero.from_values([1e-4, 1e-4, 0.1, 0.02, 8.0, 0.2]))
    job = plugin.start(TeachGoal(label="pin", grasps=2, present="ball", seed=1))
    assert plugin.result(job, LIMIT_S) == 2
    progress = dict(plugin.feedback(job).progress)
    each = progress.pop("each")
    assert [one["force_n"] > 1.0 and 5.0 < one["size_mm"] < 18.0 for one in each] == [True] * 2
    taught = progress.pop("taught")
    assert taught.items() >= {"label": "pin", "n_grasps": 3}.items()
    assert "1 of 3 grasps have no self-zero" in taught["zero_note"]
    expected = {"task": "teach", "label": "pin", "grasps": 2, "missed": 0, "of": 2, "unreached": ""}
    assert progress == expected
    assert plugin.model.labels == ("pin",)


def test_a_teaching_that_was_stopped_early_blocks_no_other(make_plugin, monkeypatch) -> None:
    compared = Mock(wraps=separation)
    monkeypatch.setattr("cell.learning.taught_model.separation", compared)
    notes: list[str] = []
    plugin = make_plugin(note=notes.append)
    done(plugin, TeachGoal(label="ball", grasps=3))
    with pytest.raises(JobFailed, match=r"box 2; each object needs at least 3"):
        done(plugin, TeachGoal(label="box", grasps=2))
    job = plugin.start(TeachGoal(label="ball", grasps=1))
    assert plugin.result(job, LIMIT_S) == 1
    assert plugin.feedback(job).progress["taught"]["left_out"] == ["box"]
    assert {grasp.label for grasp in compared.call_args.args[0]} == {"ball"}
    assert plugin.model.labels == ("ball",)
    plugin.train()
    assert notes == ["left out for too few grasps: box; teach or forget them"]
    for label, last, left in (("box", True, 5), ("ball", False, 1), ("box", False, 0)):
        plugin.result(plugin.forget(label, last=last), LIMIT_S)
        assert len(plugin.model.training_set) == left
        assert plugin.model.labels == (("ball",) if left == 5 else ())
    with pytest.raises(RequestRefused, match="'box' is not taught"):
        plugin.forget("box")


def test_an_own_name_is_taught_with_what_lies_between_the_fingers(plugin: Any) -> None:
    examples = blocks("how-to/use-from-a-host-program.md", "python")
    (typed,) = (one for one in examples if "my mug" in one)
    with pytest.raises(CellStateError, match="nothing is between the fingers"):
        plugin.start(TeachGoal(label="my mug"))
    exec(typed.replace('"grasps": 6', '"grasps": 1'), {"cell": plugin})
    assert plugin.model.labels == ("ball", "box", "my mug")
    assert (plugin.status().state, plugin.simulate({"state": True})["placed"]) == ("IDLE", None)
    parts: list[Part] = []
    plugin.watch_parts(lambda part, _grasps: parts.append(part))
    with pytest.raises(JobFailed, match="no contact"):
        done(plugin, IdentifyGoal(present="nothing"))
    done(plugin, IdentifyGoal(present="cylinder:diameter=8mm,length=20mm"))
    turn, mug = parts  # the first one without a part
    assert (turn.job, turn.task, turn.label, turn.time_s > 1e9) == (4, "identify", "", True)
    assert mug.presented == "my mug"


def test_a_part_that_nobody_can_bring_is_refused_at_once(plugin: Any) -> None:
    unknown = "'nut'; there are ball, box; or write a shape"
    for goal, error, complaint in (
        (
            {"task": "teach", "label": "nut"},
            CellStateError,
            r"`present` \(`--object`\), one of ball",
        ),
        ({"task": "identify", "present": "nut"}, ConfigError, unknown),
        ({"task": "sort", "feed": ["box", "nut"]}, ConfigError, unknown),
        ({"task": "identify"}, CellStateError, "name a part as `present`, one of ball, box"),
    ):
        with pytest.raises(error, match=complaint):
            plugin.start(goal)
    assert plugin.status().state == "IDLE"


def test_a_refused_teaching_gives_no_part_a_name(make_plugin: Any) -> None:
    plugin, states = make_plugin(), []
    goal = GripGoal(force_n=3.0, present="ball")
    ask = lambda _job: states.append(plugin.simulate({"state": True}))  # noqa: E731
    assert plugin.run(goal, on_progress=ask).held
    assert states[-1]["placed"]
    with pytest.raises(CellStateError, match="not allowed"):
        plugin.start(TeachGoal(label="my mug", grasps=3))
    assert plugin.simulate({"state": True})["objects"] == ["ball", "box"]
    with pytest.raises(CellStateError, match="release it first"):
        plugin.simulate({"place": "box"})


def test_a_reset_of_the_simulation_ends_a_fault_and_leaves_nothing_in_the_grip(make_plugin) -> None:
    plugin = make_plugin()
    for fault in (None, "servo1.off", "can.unplugged", "servo1.jump", "servo2.factory"):
        assert done(plugin, GripGoal(force_n=3.0, present="ball")).held
        if fault is not None:
            plugin.simulate({"inject": fault})
            with pytest.raises(JobFailed):
                done(plugin, VerifyGoal())
            assert plugin.status().state == "ABORTED"
        plugin.result(plugin.begin_simulation_reset(), LIMIT_S)
        assert (plugin.status().state, grip_n(plugin)) == ("IDLE", 0.0)
        assert plugin.simulate({"state": True})["faults"] == {}


# -- cancelling --------------------------------------------------------------------------------


def test_a_cancelled_job_keeps_the_grip_until_release(plugin: Any) -> None:
    pressing, go_on = threading.Event(), threading.Event()

    def cancel() -> None:
        pressing.set()
        assert go_on.wait(LIMIT_S)
        plugin.cancel(job)

    once(plugin.cell.simulated.clock, lambda: grip_n(plugin) >= 1.0, cancel)
    job = plugin.start(IdentifyGoal(present="ball"))
    assert pressing.wait(LIMIT_S)
    assert plugin.feedback(job).outcome is JobOutcome.EXECUTING
    for refused in (lambda: plugin.start(IdentifyGoal()), plugin.release):
        with pytest.raises(CellStateError, match="is not over"):
            refused()
    with pytest.raises(TimeoutError, match="not over after 0 s"):
        plugin.result(job, 0.0)
    go_on.set()
    complaint = "CANCELED: stopped on request; the grip is kept"
    with pytest.raises(JobFailed, match=complaint) as failed:
        plugin.result(job, LIMIT_S)
    assert failed.value.outcome is plugin.feedback(job).outcome is JobOutcome.CANCELED
    assert isinstance(failed.value.__cause__, CellStopped)
    assert (plugin.status().state, plugin.status().fault) == ("HELD", None)
    assert grip_n(plugin) > 0.8
    plugin.release(LIMIT_S)
    # A cancel that comes too late stops nothing of the next job.
    plugin.cancel(job)
    plugin.cell.controller.life.cancel()
    answer = done(plugin, IdentifyGoal())  # of the part that is still there
    assert (answer.label, answer.presented) == ("ball", "ball")


def test_a_job_that_is_cancelled_as_soon_as_it_is_accepted_is_cancelled(plugin: Any) -> None:
    for _ in range(3):
        job = plugin.start(IdentifyGoal(present="ball"))
        plugin.cancel(job)
        with pytest.raises(JobFailed, match="CANCELED"):
            plugin.result(job, LIMIT_S)
        if plugin.status().state == "HELD":
            plugin.release(LIMIT_S)
        assert plugin.status().state == "IDLE"
    done(plugin, GripGoal(present="ball", force_n=3.0))
    job = plugin.start_command(Command.RELEASE)
    plugin.cancel(job)
    with pytest.raises(JobFailed, match="CANCELED"):
        plugin.result(job, LIMIT_S)
    assert plugin.status().holding


@pytest.fixture
def few_collected() -> Iterator[None]:
    """Leave what other tests have made out of collections: they would take long."""
    gc.freeze()
    yield
    gc.unfreeze()


@pytest.mark.usefixtures("few_collected")
def test_a_plugin_that_is_dropped_disconnects_and_ends_its_threads(plugin_class) -> None:
    # The mover refers to the host: only the collector finds that nobody does.
    host = list[Any]()
    mover = partial(lambda _host, _pose: None, host)
    host.append(plugin_class(quick_config(host_timeout_s=1000.0), mover=mover))
    assert host[0].result(host[0].start(GripGoal(force_n=3.0, present="ball")), LIMIT_S).held
    threads = [host[0]._worker._thread, host[0]._lease._thread]
    disconnected: list[bool] = []
    host[0].cell._closing.callback(disconnected.append, True)
    plugin = weakref.ref(host[0])
    del host, mover
    # The worker refers to it until its job has returned.
    with pytest.warns(ResourceWarning, match="dropped without close"):
        until(lambda: gc.collect() >= 0 and plugin() is None)
    for thread in threads:
        thread.join(LIMIT_S)
        assert not thread.is_alive()
    assert disconnected


# -- faults ------------------------------------------------------------------------------------


def test_a_servo_at_fault_is_latched_at_loading_and_mended_by_clear(make_plugin: Any) -> None:
    plugin = make_plugin(quick_config(simulator__faults=["servo1.overload"]))
    assert plugin.status().state == "ABORTED"
    assert "0x20: overload" in plugin.status().fault
    with pytest.raises(CellStateError, match="0x20: overload"):
        plugin.start(TeachGoal(label="ball", grasps=1))
    with pytest.raises(ServoFault, match="clear it with a reboot"):
        plugin.clear()
    assert plugin.status().state == "ABORTED"
    plugin.clear(reboot=True)
    assert (plugin.status().fault, plugin.status().fault_number) == (None, 0)
    assert str(plugin.release(LIMIT_S)) == "the fingers are open"
    plugin.reset(LIMIT_S)
    assert plugin.status().state == "IDLE"
    assert done(plugin, GripGoal(force_n=3.0, present="ball")).held


@pytest.mark.parametrize(
    ("fault", "error"), [("unit.off", NodeMissing), ("servo1.off", VerificationFailed)]
)
def test_a_device_that_is_missing_at_the_start_is_an_error_of_the_constructor(
    plugin_class: Any, meddle: Any, fault: str, error: type[Exception]
) -> None:
    built = meddle(lambda made: made.simulated.inject(fault))
    threads = threading.active_count()
    with pytest.raises(error):
        plugin_class(quick_config())
    assert built[-1].simulated.clock.on_advance == []
    assert threading.active_count() == threads


# -- who moves ---------------------------------------------------------------------------------


def test_the_host_moves_and_may_veto(make_plugin: Any, taught: Any) -> None:
    asked: list[Pose] = []
    answers: list[Any] = [Pose(x_m=5e-4), False]

    def mover(pose: Pose) -> Any:
        asked.append(pose)
        with pytest.raises(CellStateError, match="close from another thread"):
            plugin.close()
        return answers[len(asked) - 1]

    plugin = make_plugin(mover=mover, model=taught.result.model)
    with pytest.raises(ConfigError, match="a sort needs the callback `places` of a Python host"):
        plugin.start(SortGoal())
    assert done(plugin, {"task": "teach", "label": "ball", "grasps": 1}) == 1
    label, placed = plugin.cell.simulated.world.placed
    assert label == "ball"
    assert placed.x_m == pytest.approx(5e-4)
    with pytest.raises(JobFailed, match="ABORTED: the host refused to move"):
        done(plugin, IdentifyGoal())
    assert plugin.status().state == "IDLE"
    assert plugin.status().fault is None
    assert not plugin.cell.controller.life.holding
    answers.append(None)
    assert done(plugin, IdentifyGoal(max_grasps=1)).n_grasps == 1


def test_only_teaching_reads_the_grasps_of_a_loaded_model(make_plugin, taught, tmp_path) -> None:
    path = tmp_path / "m.npz"
    data = taught.result.model.read_bytes()
    at = data.index(b"grasps.counts.npy") + 200
    path.write_bytes(data[:at] + bytes(50) + data[at + 50 :])
    plugin = make_plugin(model=path)
    assert done(plugin, IdentifyGoal(max_grasps=1, present="ball")).n_grasps == 1
    with pytest.raises(JobFailed, match=r"m\.npz is a damaged .*array grasps\.counts"):
        done(plugin, TeachGoal(label="oval", grasps=3))
    with pytest.raises(DatasetError, match="damaged"):
        open_service(taught.config, model=path)
    path.write_bytes(data)
    os.utime(path, ns=(0, 0))
    with pytest.raises(JobFailed, match="another program wrote"):
        done(plugin, TeachGoal(label="oval", grasps=3))
    assert plugin.model.labels == ("ball", "box")


# -- the file that each teaching renews --------------------------------------------------------


def test_each_teaching_is_saved_before_its_job_succeeds(
    make_plugin: Any, taught: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In the place of the model that was loaded, here by another name of its folder."""
    path, running, save = tmp_path / "m.npz", [], TaughtModel.save
    make_plugin(model=taught.result.model).save(path)
    before = path.read_bytes()
    (tmp_path / "link").symlink_to(tmp_path)
    plugin = make_plugin(model=path, save=tmp_path / "link" / "m.npz")

    def look(model: TaughtModel, *arguments: Any, **options: Any) -> None:
        save(model, *arguments, **options)
        running.append(plugin._worker.running)

    monkeypatch.setattr(TaughtModel, "save", look)
    done(plugin, TeachGoal(label="ball", grasps=1))
    plugin.result(plugin.forget_drift(), LIMIT_S)
    assert running == [True]  # and once for each teaching
    make_plugin(model=path).save(path)
    done(plugin, TeachGoal(label="cup", present="box", grasps=2, train=False))
    with pytest.raises(ModelError, match=r"another program wrote .*m\.npz since this one did"):
        plugin.close()
    path.unlink()
    plugin.save(path)
    assert [grasp.label for grasp in read_grasps(path)].count("cup") == 2
    assert path.read_bytes() != before
    assert make_plugin(model=path).model.labels == ("ball", "box")


def test_a_teaching_that_cannot_be_saved_says_so_and_is_tried_again_and_at_the_end(
    make_plugin: Any, taught: Any, tmp_path: Path
) -> None:
    where = tmp_path / "folder"
    where.write_text("a file where a folder should be")
    path, notes = where / "model.npz", list[str]()
    plugin = make_plugin(model=taught.result.model, save=path, note=notes.append)
    assert f"no teaching can be saved to {path} before {where} is a writable folder" in notes
    with pytest.raises(JobFailed, match="ball is taught and in use, but not saved: cannot ") as bad:
        done(plugin, TeachGoal(label="ball", grasps=1))
    assert (bad.value.fault_number, plugin.status().state) == (706, "IDLE")
    done(plugin, GripGoal(force_n=3.0))
    where.unlink()
    where.mkdir()
    done(plugin, VerifyGoal())
    assert not path.exists()  # a part is held: nothing but its watch counts
    plugin.release()
    assert make_plugin(model=path).model.labels == ("ball", "box")
    shutil.rmtree(where)
    done(plugin, TeachGoal(label="ball", grasps=1, train=False))
    for fails in (plugin.train, plugin.close):
        with pytest.raises(ModelError, match=r"the folder .* does not exist"):
            fails()
    plugin.close()


def test_a_teaching_that_was_stopped_adds_its_grasps(make_plugin, taught, tmp_path) -> None:
    path = tmp_path / "new.npz"
    plugin = make_plugin(model=taught.result.model, save=path)
    done(plugin, TeachGoal(label="ball", grasps=1))
    before = path.read_bytes()
    job = plugin.start(TeachGoal(label="box", grasps=50))
    until(lambda: plugin.feedback(job).progress.get("grasps", 0))
    plugin.cancel(job)
    with pytest.raises(JobFailed, match="CANCELED"):
        plugin.result(job, LIMIT_S)
    plugin.close()
    assert path.read_bytes() != before
    assert len(read_grasps(path)) >= 12


@pytest.mark.parametrize("loaded", [True, False])
def test_a_file_that_was_not_loaded_is_never_the_one_to_save_to(
    make_plugin: Any, taught: Any, tmp_path: Path, loaded: bool
) -> None:
    path = tmp_path / "m.npz"
    path.write_bytes(b"the work of a day")
    with pytest.raises(ConfigError, match=r"m.npz exists, .* load it \(`--model .*m.npz`\)"):
        make_plugin(model=taught.result.model if loaded else None, save=path)
    assert path.read_bytes() == b"the work of a day"


@pytest.mark.parametrize("way", ["too few grasps", "stopped", "at the end"])
def test_a_first_teaching_that_fails_removes_no_file(make_plugin, tmp_path: Path, way: str) -> None:
    path = tmp_path / "m.npz"
    plugin = make_plugin(save=path)
    # Another program writes it meanwhile: the plugin has nothing better.
    path.write_bytes(b"a model")
    job = plugin.start(TeachGoal(label="ball", grasps=1 if way == "too few grasps" else 9))
    if way == "stopped":
        plugin.cancel(job)
    if way == "at the end":
        plugin.close()
    else:
        with pytest.raises(JobFailed):
            plugin.result(job, LIMIT_S)
    if way == "too few grasps":
        plugin.result(plugin.forget("ball"), LIMIT_S)
    plugin.close()
    assert path.read_bytes() == b"a model"


def test_what_was_forgotten_is_removed_once_it_can_be(make_plugin, taught, tmp_path) -> None:
    path = tmp_path / "m.npz"
    plugin = make_plugin(model=taught.result.model, save=path)
    for label in ("ball", "box"):
        plugin.result(plugin.forget(label, last=True), LIMIT_S)
    assert path.exists()
    plugin.result(plugin.forget("ball"), LIMIT_S)
    own = path.rename(tmp_path / "own.npz")
    path.write_bytes(b"a model of another program")
    with pytest.raises(JobFailed, match=r"box is forgotten, but .* another program wrote"):
        plugin.result(plugin.forget("box"), LIMIT_S)
    path.unlink()
    path.mkdir()  # what cannot be removed
    with pytest.raises(ModelError, match=r"m\.npz cannot be removed"):
        plugin._file.write()
    path.rmdir()
    own.rename(path)
    plugin.close()
    assert not path.exists()
    with pytest.raises(CellStateError, match="is closed"):
        plugin.simulate({"state": True})


# -- goals and models --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("goal", "complaint"),
    [
        (None, "goal is None; write a goal, for example IdentifyGoal, or a mapping"),
        ("teach", "goal is 'teach'; write"),
        ({"task": ["teach"]}, "goal has task ['teach']; write one of"),
        ({"task": "identify", 3: 1}, "goal identify: 3"),
        ({}, "goal has task None; write one of teach, gauge"),
        ({"task": "teach", "label": "a", "grasps": 0}, "goal teach: grasps"),
        ({"task": "teach", "label": "a", "grasps": "3"}, "goal teach: grasps"),
        (
            {"task": "identify", "max_grasps": 101},
            "goal identify: max_grasps: must be less than or equal to 100",
        ),
        ({"task": "identify", "speed": 2}, "goal identify: speed"),
        ({"task": "identify", "present": "\x1b[2J"}, "goal identify: present"),
        ({"task": "identify", "seed": 10**5000}, "goal identify: seed"),
        ({"task": "grip", "force_n": 0.0}, "goal grip: force_n"),
    ],
)
def test_goals_are_checked(goal: Any, complaint: str) -> None:
    with pytest.raises(ConfigError) as caught:
        checked_goal(goal)
    assert complaint in str(caught.value)


def test_both_forms_of_an_umlaut_are_one_name() -> None:
    assert TeachGoal(label="Nu\u0308sse").label == "N\u00fcsse"


def test_nothing_taught_is_nothing_to_identify_or_save(make_plugin: Any, tmp_path: Path) -> None:
    plugin = make_plugin()
    for ask in (lambda: plugin.start(IdentifyGoal()), lambda: plugin.save(tmp_path / "m.npz")):
        with pytest.raises(CellStateError, match="nothing was taught"):
            ask()


def test_a_model_of_other_pads_is_refused_before_the_cell_is_touched(
    plugin_class: Any, taught: Any, tmp_path: Path, meddle: Any
) -> None:
    touched = meddle(lambda _made: None)
    with pytest.raises(ModelError, match="teach again on these pads"):
        plugin_class(small_config(tactile__layout="pinch"), model=taught.result.model)
    with pytest.raises(ConfigError, match=r"none\.yaml"):
        plugin_class(str(tmp_path / "none.yaml"))
    assert touched == []


@pytest.mark.slow
def test_config_files_and_the_context_manager(plugin_class: Any, tmp_path: Path) -> None:
    path = tmp_path / "cell.yaml"
    path.write_text("name: from a file\nself_zero: never\ngripper: {port: simulated}\n")
    with plugin_class(path) as plugin:
        assert plugin.info()["name"] == "from a file"
    assert plugin.status().state == "STOPPED"
    with pytest.raises(CellStateError, match="the cell is closed"):
        plugin.connect()


def test_an_idle_cell_in_real_time_is_supervised(make_plugin: Any, meddle: Any) -> None:
    def live(made: Any) -> None:
        made.realtime = True
        tick = made.controller.life.tick
        made.controller.life.tick = lambda: (made.simulated.clock.sleep(0.005), tick())

    meddle(live)
    plugin = make_plugin()
    plugin.cell.simulated.inject("unit.off")
    until(lambda: plugin.status().state == "ABORTED")
    assert plugin.status().fault


# -- Parts that a host has kept, through the plugin ------------------------------------------------


def test_a_part_is_gripped_without_a_name_and_survives_the_end_of_the_host(make_plugin) -> None:
    plugin = make_plugin()
    job = plugin.start({"task": "grip", "force_n": 5.0, "present": "box"})
    verification = plugin.result(job, LIMIT_S)
    assert (verification.held, verification.same, verification.reasons) == (True, True, ())
    assert verification.force_n == pytest.approx(4.0, abs=0.7)
    assert verification.opening_m == pytest.approx(9.0e-3, abs=0.5e-3)
    assert plugin.feedback(job).progress["carry_force_n"] == 4.0
    plugin.cancel(job)  # changes nothing for a kept part
    plugin.cell.controller.life.cancel()
    plugin.cell.controller.life.tick()
    status = plugin.status()
    assert (status.state_number, status.needs_reset, status.holding) == (17, False, True)
    plugin.close()
    assert grip_n(plugin) > 3.0


def test_a_part_is_held_with_no_more_force_than_a_grip_asked_for(plugin: Any) -> None:
    for asked, held_n in (({}, 4.0), ({"force_n": 1.5}, 1.5)):
        job = plugin.start({"task": "grip", "present": "box"} | asked)
        assert plugin.result(job, LIMIT_S).force_n == pytest.approx(held_n, abs=0.5)
        assert plugin.feedback(job).progress["carry_force_n"] == held_n
        assert done(plugin, VerifyGoal()).same
        plugin.release()
    done(plugin, IdentifyGoal(present="box", keep="always", max_grasps=1))
    assert grip_n(plugin) > 3.0


def test_the_force_of_the_grasps_is_the_hosts(make_plugin, taught) -> None:
    plugin = make_plugin(small_config(gripper__aperture_open_mm=12.0), model=taught.result.model)
    job = plugin.start(IdentifyGoal(present="box", force_n=3.5, seed=9))
    answer, progress = plugin.result(job, LIMIT_S), plugin.feedback(job).progress
    assert answer.probability == answer.probabilities[answer.label]
    assert Part(label=UNKNOWN).probability == 0.0
    assert (answer.shape.kind, answer.shape.n_grasps) == ("flat", answer.n_grasps)
    reported = {"task": "identify", "grasps": answer.n_grasps, "best": answer.label}
    assert progress.items() >= (reported | {"of": 4, "force_n": 3.5}).items()
    assert progress["shape"].startswith("flat, ")
    with pytest.raises(ConfigError, match="force_n"):
        plugin.start({"task": "identify", "force_n": 0.0})
    with pytest.raises(JobFailed, match=r"ABORTED: at most .*; the ramp asks for 50"):
        done(plugin, GripGoal(force_n=50.0))
    assert plugin.status().fault is None


def test_after_a_part_was_let_go_the_zero_is_compared_with_new_frames(make_plugin, monkeypatch):
    plugin = make_plugin()
    done(plugin, GripGoal(force_n=3.0, present="box"))
    sensor = plugin.cell.controller.hand.sensor
    drifted = Mock(side_effect=[ZeroDrifted("the fingers still touch"), None])
    monkeypatch.setattr(sensor, "check_zero", drifted)
    monkeypatch.setattr(sensor, "refresh", renewed := Mock())
    plugin.release()
    assert (drifted.call_count, renewed.call_count) == (2, 1)


# -- Sorting: named parts at their places, rejects, and what ends a sort ---------------------------


BINS = [{"label": "ball", "place": "bin 1"}, {"label": "box", "place": "bin 2"}]


class Sorter:
    """A plugin that sorts, and what its host saw at each place."""

    def __init__(self, make_plugin: Any, *answers: tuple[float, float], **changes: Any) -> None:
        config = quick_config(**{"sort.places": BINS} | changes)
        self.seen: list[tuple[str, str | None]] = []
        self.forces_n: list[float] = []
        self.on_place: Callable[[Destination], Any] = lambda _destination: None
        self.plugin = make_plugin(config, places=self._places)
        named = Trained(recognizer=Scripted(*answers), trainer_name="scripted")
        self.plugin.model._trained = named
        self.life = self.plugin.cell.controller.life
        self.parts: list[Part] = []
        self.plugin.watch_parts(lambda part, _grasps: self.parts.append(part))

    def sort(self, *feed: str) -> Any:
        """Sort these parts to the end of the job; return the job."""
        job = self.plugin.start(SortGoal(parts=len(feed), feed=feed, seed=7))
        return self.plugin._worker.wait(job, None)

    def _places(self, destination: Destination) -> Any:
        placed = self.plugin.cell.simulated.world.placed
        self.seen.append((destination.place, None if placed is None else placed[0]))
        self.forces_n.append(grip_n(self.plugin))
        return self.on_place(destination)


@pytest.fixture
def sorter(make_plugin: Any) -> Sorter:
    return Sorter(make_plugin, SURE)


def test_each_part_is_held_until_it_is_at_its_place(make_plugin: Any) -> None:
    share, unknown = SURE
    sorter = Sorter(make_plugin, SURE, (1.0 - share, unknown), STRANGE)
    sorter.plugin.watch_parts(raising(OSError("disk full")))  # it ends no job
    tally = sorter.sort("ball", "box", "ball").progress
    assert sorter.seen == [("bin 1", "ball"), ("bin 2", "box"), ("reject", "ball")]
    assert min(sorter.forces_n) > 3.0
    assert (sorter.life.state, grip_n(sorter.plugin)) == (CellState.IDLE, 0.0)
    assert tally["places"] == {"bin 1": 1, "bin 2": 1, "reject": 1}
    assert (tally["share_named"], tally["mistakes"]) == (pytest.approx(2 / 3), [])
    assert tally["matrix"]["ball"] == {"bin 1": 1, "bin 2": 0, "reject": 1}
    parts = [(part.number, part.label, part.job, part.task) for part in sorter.parts]
    assert parts == [(1, "ball", 1, "sort"), (2, "box", 1, "sort"), (3, UNKNOWN, 1, "sort")]


def test_a_part_in_another_bin_is_a_mistake_and_a_reject_is_none(taught: Any) -> None:
    config = changed_config(taught.config, {"sort.places": BINS})
    tally = SortAnswer(targets=Places(config, ("ball", "box")))
    for number, (truth, place) in enumerate(
        [("ball", "bin 1"), ("ball", "bin 2"), ("box", "reject"), ("", "bin 1")]
    ):
        tally.add(Part(number=number, presented=truth, place=place))
    assert tally.mistakes == [{"number": 1, "was": "ball", "place": "bin 2"}]
    assert tally.n_rejected == 1
    assert tally.matrix() == {
        "ball": {"bin 1": 1, "bin 2": 1, "reject": 0},
        "box": {"bin 1": 0, "bin 2": 0, "reject": 1},
    }


def test_a_part_that_changed_in_the_grip_goes_to_the_rejects(sorter: Sorter) -> None:
    def shove(destination: Destination) -> None:
        if destination.place != "reject":
            sorter.plugin.cell.simulated.world.slide(2.5e-3)

    sorter.on_place = shove
    assert sorter.sort("ball").progress["mistakes"] == []
    assert [place for place, _ in sorter.seen] == ["bin 1", "reject"]
    (part,) = sorter.parts
    assert (part.label, part.place) == ("ball", "reject")
    assert any("footprint" in reason for reason in part.changed)


def test_a_stop_just_before_a_part_is_let_go_keeps_it(sorter: Sorter) -> None:
    verify = sorter.plugin.cell.controller.kept_part.verify

    def then_cancel() -> Any:
        check = verify()
        sorter.life.cancel()
        return check

    sorter.on_place = lambda _destination: True  # is an answer too: the part is there
    sorter.plugin.cell.controller.kept_part.verify = then_cancel
    job = sorter.sort("ball", "box")
    assert "before it was let go" in job.error
    assert (job.part.label, job.part.in_grip) == ("ball", True)
    assert sorter.life.state is CellState.COMPLETE
    assert grip_n(sorter.plugin) > 3.0


def test_a_part_whose_release_finds_a_drifted_zero_is_counted(sorter: Sorter) -> None:
    sensor = sorter.plugin.cell.controller.hand.sensor
    drifted = raising(ZeroDrifted("the zero has drifted"))
    sorter.on_place = lambda _destination: setattr(sensor, "check_zero", drifted)
    job = sorter.sort("ball", "box")
    assert ("the zero has drifted" in job.error, grip_n(sorter.plugin)) == (True, 0.0)
    assert job.progress["places"] == {"bin 1": 1, "bin 2": 0, "reject": 0}
    assert [part.place for part in sorter.parts] == ["bin 1"]


def test_turns_without_a_part_are_counted_and_three_in_a_row_end_the_sort(make_plugin: Any) -> None:
    sorter = Sorter(make_plugin, SURE, **{"sequence.x_mm": [0.0, 0.0]})
    positioner = sorter.plugin.cell.controller.moves.positioner
    place, placed = positioner.move_to, list[Pose]()

    def move_to(pose: Pose, *_supervise: Any) -> Pose:
        """Take the object away before the fingers close, in all grasps but the second one."""
        placed.append(place(pose))
        if len(placed) != 2:
            sorter.plugin.cell.simulated.remove()
        return placed[-1]

    positioner.move_to = move_to
    job = sorter.sort(*["ball"] * 8)
    assert isinstance(job.exception, NoPartFound)
    assert len(placed) == 5
    assert (job.progress["n_missed"], job.progress["places"]["bin 1"]) == (4, 1)


def test_places_are_checked_before_anything_is_sorted(taught: Any) -> None:
    with pytest.raises(ConfigError, match=r"no place for box: add a place for each"):
        Places(changed_config(taught.config, {"sort.places": BINS[:1]}), ("ball", "box"))
    with pytest.raises(ConfigError, match=r"sort\.places repeat"):
        changed_config(taught.config, {"sort.places": [BINS[0], BINS[0]]})
    places = Places(taught.config, ("ball", "box"))
    assert places.names == ("ball", "box", "reject")
    assert places.of(UNKNOWN).place == "reject"
    entry = {"label": "ball", "place": "left", "pose": {"x_mm": 120.0, "rotation_deg": 90.0}}
    posed = changed_config(taught.config, {"sort.places": [entry, BINS[1]]})
    pose = Places(posed, ("ball", "box")).of("ball").pose
    assert (pose.x_m, pose.rotation_rad) == pytest.approx((0.12, 1.5708), abs=1e-4)


# -- The thread of a cell with its jobs; a host that falls silent; the levels of health ------------


@pytest.fixture
def make_worker(undo: ExitStack) -> Callable[..., CellWorker]:
    """Return the maker of workers, by default without supervision; they end with the test."""

    def make(**options: Any) -> CellWorker:
        made = CellWorker(**{"idle": lambda: None, "idle_period_s": None} | options)
        undo.callback(made.close, 10.0)
        return made

    return make


@pytest.fixture
def worker(make_worker: Any) -> CellWorker:
    return make_worker()


def test_jobs_of_others_and_closed_worker_are_refused(worker, make_worker) -> None:
    with pytest.raises(CellStateError, match="no job 77"):
        worker.status(Job(number=77, worker="another"))
    other = make_worker()
    ours, theirs = (each.start("work", lambda _report: None) for each in (worker, other))
    assert ours.number == theirs.number
    for ask in (worker.status, lambda job: worker.wait(job, 0.0)):
        with pytest.raises(CellStateError, match="no job 1 in this cell"):
            ask(theirs)
    other.close(5.0)
    with pytest.raises(CellStateError, match="closed"):
        other.start("work", lambda _report: None)


def stuck(make_worker: Any) -> tuple[CellWorker, threading.Event]:
    """Return a worker whose thread hangs between jobs, and what lets it go on."""
    looking, go_on = threading.Event(), threading.Event()
    worker = make_worker(idle=lambda: (looking.set(), go_on.wait(10.0)), idle_period_s=0.001)
    assert looking.wait(10.0)
    return worker, go_on


def test_what_is_started_while_the_end_is_awaited_is_refused(make_worker) -> None:
    worker, go_on = stuck(make_worker)
    with pytest.raises(TimeoutError, match="has not ended after 0 s"):
        worker.close(0.0)
    with pytest.raises(CellStateError, match="closed"):
        worker.start("work", lambda _report: None)
    go_on.set()


def test_every_job_that_is_accepted_beside_a_close_ends(make_worker) -> None:
    for _ in range(50):
        worker = make_worker()
        accepted, first = [], threading.Event()

        def start(worker=worker, accepted=accepted, first=first) -> None:
            while True:
                try:
                    accepted.append(worker.start("work", lambda _report: None))
                except CellStateError as error:
                    if "closed" in str(error):
                        return
                first.set()

        starter = threading.Thread(target=start)
        starter.start()
        assert first.wait(10.0)
        worker.close(10.0)
        starter.join(10.0)
        assert all(worker.status(job).outcome is JobOutcome.SUCCEEDED for job in accepted)


def test_a_thread_that_is_stuck_between_jobs_does_not_work(make_worker) -> None:
    worker, go_on = stuck(make_worker)
    assert worker.working
    worker.looked_s -= 60.0
    assert not worker.working
    worker.start("work", lambda _report: None)
    assert worker.working  # it has a job
    go_on.set()


@pytest.mark.parametrize("way", ["report", "period"])
def test_a_job_has_a_longest_time_without_progress(make_worker, way: str) -> None:
    go_on, reported, over = (threading.Event() for _ in range(3))
    moved_s = [0.0]

    def hangs(report: Report) -> None:
        go_on.wait(10.0)
        report({"grasps": 1})
        reported.set()
        over.wait(10.0)

    worker = make_worker(progressed_s=lambda: moved_s[0])
    job = worker.start("work", hangs)
    until(lambda: worker.status(job).outcome is JobOutcome.EXECUTING)
    worker.looked_s -= JOB_SILENT_S - 1.0
    assert worker.working
    worker.looked_s -= 2.0
    assert not worker.working
    if way == "report":
        go_on.set()
        assert reported.wait(10.0)
    else:
        moved_s[0] = time.monotonic()
    assert worker.working
    go_on.set()
    over.set()


def test_a_wait_answers_a_signal_that_another_thread_got(worker: CellWorker) -> None:
    answered, started = threading.Event(), threading.Event()

    def job(_report: object) -> bool:
        main = threading.main_thread().ident or 0
        while sys._current_frames()[main].f_code is not threading.Condition.wait.__code__:
            started.wait(0.001)
        started.wait(0.01)
        signal.pthread_kill(threading.get_ident(), signal.SIGUSR1)
        return answered.wait(10.0)

    before = signal.signal(signal.SIGUSR1, lambda *_given: answered.set())
    try:
        status = worker.wait(worker.start("work", job), 20.0)
    finally:
        signal.signal(signal.SIGUSR1, before)
    assert status.value is True


# -- A host that falls silent while a job runs -----------------------------------------------------


def test_a_silence_is_told_once_and_again_after_the_host_was_heard() -> None:
    clock, silences = Clock(), []
    lease = Lease(3600.0, given=lambda _name: None, lost=silences.append, clock=clock)

    def look(now_s: float) -> list[str]:
        clock.now_s = now_s
        lease.has(0)
        return [re.findall(r"[0-9.]+", text)[0] for text in silences]

    assert look(1.0) == []
    with lease.calling("host"):
        pass
    assert look(3601.0) == []
    assert look(3602.0) == look(9000.0) == ["3601.00"]
    with lease.calling("host"), lease.calling("host"):
        pass
    with lease.calling("host"):
        assert look(20_000.0) == ["3601.00"]  # a host that waits in a call is there
    assert look(23_600.0) == ["3601.00"]
    assert look(23_601.0) == ["3601.00", "3601.00"]


def test_the_watch_over_the_lease_survives_its_errors(monkeypatch) -> None:
    lease, notes = Lease(0.1, given=Mock(), lost=Mock()), list[str]()
    monkeypatch.setattr(lease, "_check_expiry", raising(ValueError("a bug")))
    lease.watch(notes.append)
    until(lambda: len(notes) > 1)
    lease.close()
    assert "watch over the lease: " in notes[1]


@pytest.mark.slow
def test_a_silence_stops_the_job_that_runs_alone_and_its_end_can_be_read() -> None:
    with TactileCellPlugin(quick_config(host_timeout_s=0.2)) as plugin:
        life = plugin.cell.controller.life
        plugin.alive()
        until(lambda: not plugin._lease.number)
        assert not life.cancelled
        job = plugin.start(TeachGoal(label="ball", grasps=1000))
        until(lambda: not plugin._worker.running)
        status = plugin.feedback(job)
        assert status.outcome is JobOutcome.CANCELED
        assert "stopped because 'the host' was silent for 0." in status.error
        assert life.state in (CellState.HELD, CellState.IDLE)
        with pytest.raises(JobFailed, match="'the host' was silent"):
            plugin.result(job, 1.0)
        if life.state is CellState.HELD:
            plugin.release(LIMIT_S)
        assert plugin.status().state_number == CellState.IDLE.number


def test_each_call_of_the_host_is_heard() -> None:
    with TactileCellPlugin(quick_config(host_timeout_s=1000.0)) as plugin:
        for call in (plugin.alive, plugin.status, plugin.forget_drift):
            plugin._lease._heard_s = -1.0
            call()
            assert plugin._lease._heard_s > 0.0, call


def test_a_lost_recording_holds_the_grasp_where_the_config_says_so_until_there_is_room(
    make_bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = make_bench(quick_config(recording__when_lost="hold"), folder=tmp_path).ready()
    room = fill_disk_after(monkeypatch, 0)
    with pytest.raises(RecordingError, match="No space left"):
        bench.grasp(6.0)
    assert bench.controller.life.state is CellState.ABORTED
    assert "No space left" in bench.cell.health()["recording"]
    health = health_values(bench.config, bench.cell, None)["recording"]
    assert (health["level"], health["path"]) == ("bad", str(tmp_path / "recording.mcap"))
    room[0] = 1 << 40
    bench.life.clear()
    bench.controller.release_held()
    bench.life.reset()
    bench.controller.start()
    bench.grasp(6.0)
    assert bench.cell.health()["recording"] is None
    health = health_values(bench.config, bench.cell, None)["recording"]
    assert (health["level"], health["path"]) == ("ok", str(tmp_path / "recording-2.mcap"))
    bench.cell.close()
    assert len(read_recording(tmp_path / "recording-2.mcap").grasps) == 1


# -- Health of a cell: its levels follow the limits of the config ----------------------------------


@pytest.mark.parametrize(
    ("limit", "level"),
    [({}, "ok"), ({"current_max_a": 9.0}, "watch"), ({"temperature_max_c": 20.0}, "bad")],
    ids=str,
)
def test_heat_is_judged_by_the_limit_and_where_the_current_is_lowered(
    make_bench, limit: dict[str, float], level: str
) -> None:
    bench = make_bench().ready()
    gripper = bench.config.gripper.model_copy(update=limit)
    config = bench.config.model_copy(update={"gripper": gripper})
    assert health_values(config, bench.cell, None)["servos"]["level"] == level


def test_lost_frames_are_judged_by_their_limit(make_bench) -> None:
    bench = make_bench(small_config(tactile__loss_max_share=0.5))
    assert health_values(bench.config, bench.cell, None)["can"] is None
    bench.ready()
    assert health_values(bench.config, bench.cell, None)["can"]["level"] == "ok"
    bench.simulated.inject("can.lose_next=12")
    bench.idle(0.25)
    assert health_values(bench.config, bench.cell, None)["can"]["level"] == "watch"
    strict = small_config(tactile__loss_max_share=0.001)
    assert health_values(strict, bench.cell, None)["can"]["level"] == "bad"


def test_too_little_space_for_the_recording_is_watched(make_bench, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(retention, "free_bytes", lambda _folder: 18_000_000)
    folder, notes = tmp_path / "run-20270115-080000", list[str]()
    folder.mkdir()
    config = small_config(recording__keep_gb=2.0)
    cell = make_bench(config, folder=folder, note=notes.append).cell
    until(lambda: cell.recording_problem)
    recording = health_values(config, cell, None)["recording"]
    assert (recording["level"], [recording["text"]]) == ("watch", notes)
    assert notes[0].startswith(f"the disk of {tmp_path} has less than 500 MB free")
    assert cell._retention._keep_bytes == 2e9
