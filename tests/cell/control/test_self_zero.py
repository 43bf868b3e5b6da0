"""The self-zero of a simulated cell: against its truth, with a part between, when it is due."""

import json
import math
import time
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import DEFAULT, Mock

import pytest

from cell.commissioning.doctor import examine
from cell.commissioning.findings import Verdict
from cell.config.file import changed_config, config_text, load_config, parse_config
from cell.config.model import CellConfig
from cell.control.plan import GraspStep, Pose
from cell.control.states import CellState
from cell.control.zeroing import SelfZeros, stored_zeros, unsound, zero_file
from cell.errors import CellError, PartInGrip, PlanRefused, ZeroRefused
from cell.files import SELF_ZERO, write_json
from cell.interfaces.cli.session import cell_config
from cell.recording.dataset import read_grasps
from cell.runtime import tasks
from cell.runtime.goals import ZeroGoal, checked_goal
from cell.runtime.health import health_values
from cell.service.history import history_file
from gripper.dynamixel.drive import DriveCharacteristic
from gripper.dynamixel.models import MODELS
from gripper.errors import MechanicsContradicted, PartBetweenFingers
from recognition.grasp import SelfZero
from tests.cell.cells import REAL, call, quick_config, small_config
from tests.marks import LONG

PULSE_MM = 60.0 * 2.0 * math.pi / 4096.0


@pytest.mark.long
def test_what_is_measured_is_what_the_hand_is(make_bench) -> None:
    pads = {
        "shift_mm": [0.8, -1.0],
        "tilt_deg": [1.5, -1.0],
        "gains": [1.1, 0.9],
        "stiffness": [0.8, 1.3],
    }
    plain = make_bench(small_config()).ready()
    there = make_bench(
        small_config(
            simulator__pads=pads, simulator__faults=["servo1.horn=12", "servo2.horn=9"], seed=3
        )
    ).ready()
    for bench in (plain, there):
        bench.simulated.remove()
        bench.inject("taxels.offset=2")  # a drift since the start is no part between the fingers
    here, other = plain.controller.zeroing.measure().zero, there.controller.zeroing.measure().zero
    assert here.opening_m * 1e3 == pytest.approx(0.0, abs=0.15)
    assert other.opening_m * 1e3 == pytest.approx(21 * PULSE_MM, abs=0.15)
    assert math.exp(other.log_gain_ratio) == pytest.approx(1.1 / 0.9, rel=0.06)
    assert there.controller.life.state is CellState.IDLE
    assert not there.controller.life.holding
    there.controller.moves.present("ball")
    assert there.controller.grasp(GraspStep(pose=Pose(), force_n=6.0)).grasp.zero == other


@pytest.mark.parametrize(
    "hand",
    [
        LONG({"gripper__servos": [{"id": 1}]}, id="one servo makes less than 10 N"),
        LONG(
            {
                "gripper__servos": [{"id": 1}],
                "gripper__linkage": {"kind": "rack_pinion", "pinion_radius_mm": 9.0},
                "gripper__aperture_open_mm": 14.0,
                # Faster fingers may meet with the whole force of the ramp: then no zero is taken.
                "gripper__approach_speed_mm_s": 5.0,
            },
            id="a lead of 6 mm is 19 degrees of the pinion",
        ),
        LONG(
            {
                "gripper__servos": [
                    {"id": 1, "model": "XL330-M288"},
                    {"id": 2, "model": "XL330-M288"},
                ],
                "tactile__force_period_ms": 0,
                "tactile__sync_period_ms": 40.0,
                "gripper__current_max_a": 0.9,
                "sequence__force_n": [1.0, 3.0],
                "sequence__carry_force_n": 3.0,
                "simulator__pads__stiffness": [1.6, 1.9],
                "simulator__noise_level": 0.5,
            },
            id="a small position gain",
        ),
        # Noise moves the centre of a load on all taxels far.
        pytest.param(
            {
                "seed": 10,
                "simulator__servos__friction": [0.5, 1.0],
                "simulator__servos__kt": [1.3, 1.0],
                "simulator__noise_level": 2.0,
                "tactile__tare_frames": 100,
            },
            id="one stronger motor and twice the noise",
        ),
    ],
)
def test_it_is_measured_on_other_hands_below_the_cap(make_bench, hand: dict[str, Any]) -> None:
    """The set-point ends at 10 N, the cap is 15 N, and no servo was ever measured."""
    bench = make_bench(quick_config(self_zero="daily", **hand))
    pressed_n: list[float] = []
    bench.clock.on_advance.append(
        lambda _now_s: pressed_n.append(max(bench.simulated.world.contact_force_n()))
    )
    bench.start()
    assert bench.life.state is CellState.IDLE
    assert bench.controller.zeros.newest.opening_m * 1e3 == pytest.approx(0.0, abs=0.3)
    assert max(pressed_n) < 12.5


def test_fingers_of_a_small_pinion_meet_softly_and_do_not_run_open_too_far(make_bench) -> None:
    """A release ends while they run, and the next motion has little current to brake them."""
    config = load_config(Path(__file__).parents[3] / "config/open-parallel-gripper.yaml")
    bench = make_bench(changed_config(config, {"seed": 5}))
    openings_m: list[float] = []
    bench.clock.on_advance.append(lambda _now_s: openings_m.append(bench.aperture_m))
    zero = bench.start().controller.zeroing.measure().zero
    assert zero.opening_m * 1e3 == pytest.approx(0.0, abs=0.1)
    assert max(openings_m) < config.gripper_settings.aperture_open_m + 1.5e-3


@pytest.mark.parametrize(
    ("when", "part"),
    [("always", "sphere:diameter=9.5mm"), ("on_demand", "cylinder:diameter=3mm,length=60mm")],
)
def test_a_part_that_was_left_is_named_and_kept_not_zeroed_on(make_bench, when, part) -> None:
    bench = make_bench(quick_config(self_zero=when))
    ask = bench.controller.start
    if when == "on_demand":
        ask = bench.ready().controller.zeroing.measure
    bench.simulated.place(part)
    with pytest.raises(PartBetweenFingers, match="something is between them"):
        ask()
    assert bench.life.state is CellState.ABORTED
    assert bench.life.holding
    assert bench.controller.zeros.newest is None
    assert 0.3 < bench.grip_n < bench.controller.kept_part.wanted_force_n + 0.5


@pytest.mark.parametrize(
    ("part", "most_n", "says"),
    [
        # Less than any grasp presses it, not with the 10 N of a self-zero.
        ("ball", 4.0, "something is between them"),
        ("box:length=80mm,width=40mm,height=3mm", 12.0, "a flat part may be between them"),
    ],
)
def test_a_daily_start_opens_again_on_a_part_and_goes_on(
    make_bench, tmp_path, part, most_n, says
) -> None:
    config = quick_config(self_zero="daily")
    bench = make_bench(config, folder=tmp_path / "job")
    bench.simulated.place(part)
    pressed_n: list[float] = []
    bench.clock.on_advance.append(lambda _now_s: pressed_n.append(bench.grip_n))
    bench.controller.start()
    assert 0.3 < max(pressed_n) < most_n
    assert (bench.grip_n, bench.life.state) == (0.0, CellState.IDLE)
    assert not bench.life.holding
    note = bench.controller.zeroing.note
    assert says in note
    assert "`tactile-cell hand zero`; with `self_zero: on_demand`" in note
    assert bench.controller.zeros.newest is None
    assert health_values(config, bench.cell, None)["zero"] == {"level": "watch", "text": note}
    # Its file exists if the servos' friction showed in the grip.
    assert stored_zeros(config, tmp_path, new_hand=False).newest is None


@pytest.mark.usefixtures("made_up_zero")
@pytest.mark.parametrize("when", ["daily", "always"])
def test_a_zero_that_cannot_be_written_counts_in_its_program(make_bench, tmp_path, when) -> None:
    """Nobody has asked a daily start for one, and a full disk is no fault of the hand."""
    config = quick_config(self_zero=when)
    zero_file(tmp_path, config.name).mkdir()
    bench = make_bench(config, folder=tmp_path / "job")
    bench.controller.start()
    assert (bench.life.state, bench.life.holding) == (CellState.IDLE, False)
    assert bench.controller.zeros.newest is not None
    assert (
        "could not be saved for other programs: cannot write self-zero"
        in bench.controller.zeroing.note
    )
    zero_file(tmp_path, config.name).rmdir()
    bench.controller.zeros.keep_drives({1: DRIVE}, {})
    assert bench.controller.zeroing.note == ""
    assert stored_zeros(config, tmp_path, new_hand=False).newest is not None


@pytest.mark.usefixtures("made_up_zero")
def test_a_start_with_a_held_part_takes_no_zero_and_keeps_it(make_bench) -> None:
    bench = make_bench(quick_config(self_zero="always")).ready()
    bench.controller.grip(3.0, Pose())
    held_n = bench.grip_n
    bench.controller.shutdown()
    with pytest.raises(PartInGrip, match="nothing was moved"):
        bench.controller.start()
    assert bench.grip_n == pytest.approx(held_n, abs=0.3)
    assert bench.life.holding


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"simulator__faults": ["servo1.horn=-100"]}, MechanicsContradicted),
        ({"simulator__faults": ["servo1.horn=90"]}, PartBetweenFingers),
        ({"simulator__pads": {"tilt_deg": [6.0, 0.0]}}, ZeroRefused),
    ],
    ids=["horn closed", "horn open", "bent finger"],
)
def test_what_is_out_of_bounds_is_named(make_bench, monkeypatch, changes, says) -> None:
    monkeypatch.setattr("cell.control.zeroing._ZERO_RATE_N_S", 20.0)
    bench = make_bench(quick_config(**changes)).ready()
    bench.simulated.remove()
    zeroing, too_hard = bench.controller.zeroing, [ValueError("they met too fast")] * 2
    zeroing._zeroed = Mock(wraps=zeroing._zeroed, side_effect=[*too_hard, DEFAULT])
    with pytest.raises(says, match=r"zero_pulse|a tooth of a horn|a finger is bent"):
        zeroing.measure()


@pytest.mark.usefixtures("made_up_zero")
def test_a_command_and_a_job_measure_it_and_doctor_names_it(make_bench, tmp_path: Path) -> None:
    said = call("hand", "zero", "--out", tmp_path, "--json", tmp_path / "zero.json")
    assert said.startswith("pads meet at ")
    assert "since the last measurement" not in said
    assert abs(json.loads((tmp_path / "zero.json").read_text())["opening_m"]) < 2e-4
    here = changed_config(CellConfig(), {"recording.directory": str(tmp_path)})
    finding = next(one for one in examine(here) if one.what == "self-zero")
    assert (finding.verdict, finding.advice) == (Verdict.PASS, "")
    assert "pads meet at" in finding.text
    bench, reports = make_bench(quick_config()).ready(), []
    bench.simulated.remove()
    goal = checked_goal({"task": "zero"})
    assert isinstance(goal, ZeroGoal)
    file: Any = SimpleNamespace(model=None)
    result = tasks.Tasks(bench.controller, file).zero(goal, reports.append)
    assert reports[-1]["zero"] == asdict(result) | {"moved_mm": None}
    assert bench.controller.zeros.newest == result


def test_an_old_zero_of_free_taxels_is_renewed(make_bench, monkeypatch) -> None:
    monkeypatch.setattr("cell.control.zeroing._ZERO_AGE_S", 0.0)
    bench = make_bench(quick_config()).start()
    zeroing, zero = bench.controller.zeroing, bench.controller.zeroing.taxels
    bench.inject("taxels.offset=2")
    bench.simulated.world.press(0, 0.0, 0.0, 3.0)
    zeroing.open()
    assert zeroing.taxels is zero
    bench.simulated.world.lift()
    zeroing.open()
    assert (zeroing.taxels.offset_counts - zero.offset_counts).mean() > 1.0


@pytest.mark.slow
@pytest.mark.usefixtures("made_up_zero")
def test_a_teaching_begins_with_the_self_zero_that_its_grasps_carry(monkeypatch, tmp_path) -> None:
    monkeypatch.chdir(tmp_path)
    config = quick_config(self_zero="daily")
    Path("tactile-cell.yaml").write_text(config_text(config, comments=False))
    call("teach", "ball", "-n", 1, "-o", "taught.npz")
    (grasp,) = read_grasps(Path("taught.npz"))
    stored = stored_zeros(config, tmp_path / "out")
    assert grasp.zero == stored.newest
    assert stored.newest is not None
    # A simulated hand is new in each program, a real one is not.
    assert stored.due
    there = changed_config(config, REAL)
    assert stored_zeros(there, tmp_path).due
    stored_zeros(there, tmp_path).keep(ZERO)
    assert not stored_zeros(there, tmp_path).due
    # Faults are for the grasps of a command, not for a self-zero before them.
    faulty = cell_config(None, faults=["servo1.off@contact"])
    assert (config.self_zero, faulty.self_zero) == ("daily", "on_demand")


def test_fingers_that_cannot_meet_are_gauged(make_bench) -> None:
    with pytest.raises(PlanRefused, match="calibrate --gauge"):
        make_bench(quick_config(gripper__pads_meet=False)).ready().controller.zeroing.measure()
    with pytest.raises(Exception, match=r"gripper\.pads_meet is false"):
        quick_config(gripper__pads_meet=False, self_zero="daily")
    unset = changed_config(CellConfig(), {"gripper.pads_meet": False})
    assert (CellConfig().self_zero, unset.self_zero) == ("daily", "never")
    assert parse_config(config_text(unset), source="x") == unset
    with pytest.raises(PlanRefused, match="self_zero is never"):
        make_bench(quick_config(self_zero="never")).ready().controller.zeroing.measure()


DAY_S = 86_400.0
ZERO = SelfZero.from_values([1e-3, 1e-4, 0.1, 0.02, 8.0, 0.2])


@pytest.mark.parametrize("values", [{}, {"measured_s": "x"}, {"measured_s": 1e300}, {"hand": 3}])
def test_a_whole_file_of_other_values_counts_as_none(tmp_path, values) -> None:
    stored = {"measured_s": 1.8e9, "hand": {}} | (asdict(ZERO) if values else {}) | values
    write_json(tmp_path / "zero.json", SELF_ZERO, stored, error=CellError)
    zeros = SelfZeros("daily", path=tmp_path / "zero.json")
    assert zeros.newest is None
    assert "has no self-zero; `tactile-cell hand zero`" in zeros.refused
    zeros.keep(ZERO)
    assert not zeros.refused
    assert SelfZeros("daily", path=tmp_path / "zero.json").newest == ZERO


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"gripper.port": "/dev/ttyUSB1"}, "gripper.port"),
        ({"tactile.channel": "can1"}, "tactile.channel"),
        ({"tactile.serial_number": 7}, "tactile.serial_number"),
        ({"gripper.servos": [{"id": 1}, {"id": 3}]}, "gripper.servos"),
        ({"simulator.pads": {"stiffness": [0.8, 1.0]}}, "simulator.pads"),
    ],
)
def test_a_zero_of_another_cell_counts_as_none_and_is_named(tmp_path, change, named) -> None:
    here = changed_config(CellConfig(), REAL)
    stored_zeros(here, tmp_path).keep(ZERO)
    assert stored_zeros(here, tmp_path).newest == ZERO
    other = stored_zeros(changed_config(here, change), tmp_path)
    assert (other.newest, other.due) == (None, True)
    assert f"with other {named}. Give each cell a name of its own" in other.refused
    weaker = changed_config(here, {"gripper.force_max_n": 12.0})
    assert stored_zeros(weaker, tmp_path).newest == ZERO


@pytest.mark.usefixtures("made_up_zero")
def test_a_zero_of_another_control_unit_counts_as_none(make_bench, tmp_path: Path) -> None:
    """Two cells whose adapters have changed places have the same config."""
    config = quick_config()
    make_bench(config, folder=tmp_path / "first").start().controller.zeroing.measure()
    same = make_bench(config, folder=tmp_path / "same").start().controller
    assert (same.zeros.newest is None, same.zeroing.note) == (False, "")
    stored = json.loads(zero_file(tmp_path, config.name).read_text())
    del stored["format"], stored["sha256"]
    stored["hand"]["unit.boards"] = [1, 9]
    write_json(zero_file(tmp_path, config.name), SELF_ZERO, stored, error=CellError)
    other = make_bench(config, folder=tmp_path / "other").start().controller
    assert other.zeros.newest is None
    assert "with other unit.boards." in other.zeroing.note
    other.zeroing.measure()
    assert not other.zeroing.note


def test_a_zero_far_from_the_last_one_is_no_daily_one() -> None:
    zeros = SelfZeros("daily")
    assert not zeros.far_off(replace(ZERO, opening_m=0.0))
    zeros.keep(replace(ZERO, opening_m=3e-3))  # somebody has asked for it
    assert "they met last at +3.00 mm" in zeros.far_off(replace(ZERO, opening_m=0.5e-3))
    assert "the zero of the config is at +0.00 mm" in zeros.far_off(replace(ZERO, opening_m=3e-3))


def test_a_self_zero_counts_for_a_day_unless_each_start_measures_one(tmp_path: Path) -> None:
    path, now_s = tmp_path / "zero.json", [1.8e9]
    zeros = SelfZeros("daily", path=path, now_s=lambda: now_s[0])
    assert zeros.due
    zeros.keep(ZERO)
    assert not zeros.due
    now_s[0] += 0.9 * DAY_S
    assert (zeros.newest, zeros.expired) == (ZERO, "")
    assert zeros.due
    assert [SelfZeros(when, path=path).due for when in ("always", "on_demand")] == [True, False]
    now_s[0] += 0.2 * DAY_S
    assert zeros.newest is None
    assert "is older than a day" in zeros.expired
    later = SelfZeros(path=path, now_s=lambda: now_s[0])
    assert (later.newest, later.measured_s) == (None, 1.8e9)


DRIVE = replace(
    DriveCharacteristic.catalogue(MODELS["XM430-W350"]),
    breakaway_a=0.2,
    friction_sd=0.05,
    load_sd=0.02,
    temperature_c=24.0,
)


def test_drives_are_kept_with_their_servo_and_without_a_zero_too(tmp_path: Path) -> None:
    here = changed_config(CellConfig(), REAL | {"gripper.pads_meet": False})
    homing = {1: 0, 2: 0}
    stored_zeros(here, tmp_path).keep_drives({1: DRIVE}, homing)
    later = stored_zeros(here, tmp_path)
    assert later.newest is None
    assert not later.refused
    drives = later.stored_drives(homing)
    assert set(drives) == {1}
    # Friction is another one on another day; the rest is as it was measured.
    assert drives[1].friction_sd > DRIVE.friction_sd
    assert replace(drives[1], friction_sd=0.05, measured_s=0.0) == DRIVE
    assert drives[1].measured_s == pytest.approx(time.time(), abs=60.0)
    assert not later.stored_drives({1: 1024, 2: 0}), "another homing offset"
    for change in (
        {"gripper.port": "/dev/ttyUSB1"},
        {"gripper.servos": [{"id": 1, "model": "XM430-W210"}, {"id": 2}]},
        {"gripper.servos": [{"id": 3}, {"id": 2}]},
    ):
        other = stored_zeros(changed_config(here, change), tmp_path)
        assert (other.stored_drives(homing), other.measured_servo(1)) == ({}, False)
    assert later.measured_servo(1)


def test_a_measured_zero_keeps_the_drives_and_they_keep_the_zero(tmp_path: Path) -> None:
    here = changed_config(CellConfig(), REAL)
    stored_zeros(here, tmp_path).keep(ZERO)
    stored_zeros(here, tmp_path).keep_drives({2: DRIVE}, {})
    both = stored_zeros(here, tmp_path)
    assert both.newest == ZERO
    assert set(both.stored_drives({})) == {2}
    # What nobody has measured is the catalogue's, and is not kept.
    both.keep_drives({1: DriveCharacteristic.catalogue(MODELS["XM430-W350"])}, {})
    assert set(stored_zeros(here, tmp_path).drives) == {2}


def test_cells_have_files_of_their_own_whatever_their_names_have_in_common() -> None:
    names = ("cell 1", "cell-1", "cell_1", "cell/1", "cell  1", "Zelle \u00e4", "Zelle \u00f6")
    names += ("\u00e4" * 80, "\u00f6" * 80, "x" * 80, "x" * 79)
    for file_of in (zero_file, history_file):
        files = [file_of(Path("out"), name) for name in names]
        assert len(set(files)) == len(names)
        assert all(file.parent == Path("out") for file in files)
        assert max(len(file.name.encode()) for file in files) < 100
    assert zero_file(Path("out"), "cell-1").name == "self-zero-cell-1.json"


@pytest.mark.parametrize(("ratio", "weak"), [(0.5, 0), (2.0, 1)])
def test_the_pad_that_measures_less_is_the_worn_one(ratio, weak) -> None:
    zero = SimpleNamespace(log_gain_ratio=math.log(ratio))
    assert f"the pad of finger {weak} is worn" in unsound(Mock(tilt_rad=(0.0, 0.0), zero=zero))
