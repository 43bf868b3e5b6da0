"""The bench of one servo gives back the values of the simulated servo that it measures."""

import csv
import json
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from cell.commissioning.bench import Bench, LineOpener
from cell.commissioning.engine import StepFailed, WizardAborted
from cell.commissioning.servo_bench import STEPS, Rig, findings, open_rig, run_bench
from cell.config.gripper import measured_drive
from cell.errors import CellError, ConfigError
from cell.files import SERVO_BENCH, write_json
from gripper.dynamixel.bus import ServoBus
from gripper.dynamixel.drive import DriveCharacteristic
from gripper.dynamixel.models import MODELS, XL330_M288, XM430_W350
from gripper.dynamixel.serial_port import ByteStream
from simulator.servo.bus import MemoryServoStream
from simulator.servo.gearing import drawn_drive
from simulator.servo.mechanics import FingerMechanics, RackLinkage
from simulator.servo.motor import ServoMotor, ServoNoise
from tests.cell.commissioning.hands import Question, Script
from tests.simulator.conftest import ServoBench

ARM_M = 0.1
G_PER_N = 1e3 / 9.80665
SCALE_N_M = 2e4


class SimulatedBench(ServoBench, LineOpener):
    """A servo with an arm over a scale or free; and a person who sets it up."""

    def __init__(self, model: str = "XM430-W350", n_servos: int = 1) -> None:
        drawn = {"figures": drawn_drive(MODELS[model], "7"), "noise": ServoNoise("7")}
        arm = RackLinkage(pinion_radius_m=ARM_M, travel_m=0.9)
        self.place = "free"
        self.rest_m = 0.0
        super().__init__(
            range(1, 1 + n_servos),
            model=MODELS[model],
            motor=partial(ServoMotor, **drawn),
            fingers=partial(FingerMechanics, linkage=arm, aperture_m=0.0, half_opening_min_m=-0.9),
        )
        (self.motor, *_), (self.servo, *_) = self.motors, self.servos
        bus = ServoBus(self.stream, baudrate=1_000_000, clock=self.clock)
        self.rig = Rig(bus, 1, MODELS[model], self.clock)
        self.rig.press = -1

    def _force_n(self) -> float:
        way_m = self.rest_m - self.mechanics.finger_position_m[0]
        return max(0.0, SCALE_N_M * way_m) if self.place == "scale" else 0.0

    def _advance(self, now_s: float) -> None:
        n = max(1, round((now_s - self._last_s) / 1e-3))
        stiffness = SCALE_N_M if self.place == "scale" else 0.0
        for _ in range(n):
            force = self._force_n()
            slope = stiffness if force != 0.0 else 0.0
            self.mechanics.step((now_s - self._last_s) / n, (0.5 * force,) * 2, (0.5 * slope,) * 2)
        self._last_s = now_s
        self.device.advance_to(now_s)

    def open_serial(self, _port: str, baud_rate: int) -> ByteStream:
        self.device.baudrate = baud_rate
        return MemoryServoStream(self.device, self.clock)

    def put(self, place: str) -> None:
        """Set the arm up."""
        self.place = place
        self.rest_m = self.mechanics.finger_position_m[0]

    def weight_g(self) -> float:
        """Return what the scale shows, in steps of 1 g."""
        return round(self._force_n() * G_PER_N)


def person(bench: SimulatedBench, *steps: str) -> Script:
    """Return a person who runs some steps and leaves the others out."""
    places = {"scale": "scale", "heat": "scale", "watchdog": "scale"}

    def answer(question: Question) -> str | float | None:
        step, _, what = question.key.partition(".")
        if what == "begin":
            bench.put(places.get(step, "free"))
            return "run" if step in steps else "leave"
        return bench.weight_g() if step in {"scale", "watchdog"} else None

    return Script(otherwise=answer)


def measured(bench: SimulatedBench, folder: Path, *steps: str) -> dict[str, Any]:
    """Run some steps; return the values of the result."""
    _, result = run_bench(bench.rig, person(bench, *steps), folder)
    values: dict[str, Any] = json.loads(result.read_text())["values"]
    return values


@pytest.mark.parametrize("step", ["scale", "heat"])
def test_an_arm_that_leaves_the_scale_ends_the_step(tmp_path, step) -> None:
    bench = SimulatedBench()
    someone = person(bench, step)
    bench.put = lambda _place: None  # the arm stays beside the scale
    run_bench(bench.rig, someone, tmp_path)
    assert "left the scale" in " ".join(someone.said)
    assert abs(bench.rig.log[-1].velocity_rad_s) < 2.5


def test_an_arm_that_is_lifted_to_read_the_scale_ends_the_step(tmp_path) -> None:
    bench = SimulatedBench()
    someone = person(bench, "scale")
    lift = lambda: bench.put("free") or bench.clock.sleep(0.3) or 0.0  # noqa: E731
    someone.replies["scale.rising.828"] = lift
    run_bench(bench.rig, someone, tmp_path)
    assert "left the scale" in " ".join(someone.said)
    assert bench.rig.log[-1].part == "rising 0.828 A"


def truth(bench: SimulatedBench) -> dict[str, Any]:
    """Return what the steps should measure of the simulated servo."""
    model, drive = bench.rig.model, bench.motor.figures
    supply = model.supply_current
    free_nm_a = (1.0 - drive.friction.drive) * drive.kt_nm_a
    # The slope at 0.05 N.m, the middle of the loads.
    slope = 1.0 + drive.friction.load + 2.0 * 0.05 * drive.friction.load_quadratic_per_nm
    # The arm sticks on the scale.
    rising_a_nm = slope / ((1.0 - drive.breakaway * drive.friction.drive) * drive.kt_nm_a)
    return {
        "shutdown_raw": model.shutdown_raw,
        "velocity_mean_s": 0.032 if supply else 0.064,
        "velocity_low_pass_s": 0.004 if supply else 0.016,
        "error_per_pwm": pytest.approx(256 if supply else 128, rel=0.03),
        "rising_a_nm": pytest.approx(rising_a_nm, rel=0.1),
        "winding_ohm": pytest.approx(drive.winding_ohm, rel=0.05),
        "duty_exponent": pytest.approx(0.5 if supply else 1.0, abs=0.1),
        "coulomb_a": pytest.approx(drive.friction.base_nm / free_nm_a, rel=0.15),
        "back_emf_v_s": pytest.approx(drive.back_emf_v_s, rel=0.05),
    }


@pytest.mark.slow
@pytest.mark.parametrize("model", ["XM430-W350", "XL330-M288"])
def test_the_steps_measure_the_simulated_servo(tmp_path: Path, model: str) -> None:
    bench = SimulatedBench(model)
    values = measured(bench, tmp_path, "registers", "velocity", "scale", "free")
    for name, expected in truth(bench).items():
        assert values[name] == expected, name
    assert values["gains_mode_3"][:2] == [0, 0]
    assert values["gains_mode_5"][2] > 0
    assert values["breakaway_a"] >= 0.95 * values["coulomb_a"]
    assert bench.servo.registers.get("operating_mode") == 3, "the mode is that of before"


def test_silence(tmp_path: Path) -> None:
    values = measured(SimulatedBench(), tmp_path, "watchdog")
    assert values["bus_watchdog_after_silence"] == -1
    assert values["torque_enable_after_silence"] == 1
    assert 0.0 < values["held_share"] <= 1.2


@pytest.mark.long
def test_a_servo_that_trips_is_found(tmp_path: Path) -> None:
    held = measured(SimulatedBench(), tmp_path, "heat")["held"]
    assert held["0.39"]["trip_s"] is None
    assert 0.0 < held["0.99"]["trip_s"] < 30.0


def test_each_step_can_be_left_out_and_each_reading_is_in_the_log(tmp_path: Path) -> None:
    bench = SimulatedBench()
    script = person(bench, "velocity")
    (tmp_path / "file").write_text("")
    with pytest.raises(CellError, match="cannot make the folder"):
        run_bench(bench.rig, script, tmp_path / "file")
    assert not script.asked
    log, _ = run_bench(bench.rig, script, tmp_path)
    assert log.name == "servo-bench-xm430-w350-id1.csv"
    assert [key.partition(".")[0] for key in script.asked if key.endswith("begin")] == [
        step.__name__ for step in STEPS
    ]
    rows = list(csv.DictReader(log.read_text().splitlines()))
    assert len(rows) == len(bench.rig.log) > 300
    assert {row["step"] for row in rows} == {"velocity"}
    again, _ = run_bench(bench.rig, person(bench), tmp_path)
    assert again != log, "no earlier log is overwritten"


def test_a_person_who_leaves_keeps_what_was_measured_and_the_torque_is_off(tmp_path: Path) -> None:
    bench = SimulatedBench()
    script = person(bench, "registers", "scale")
    script.leave_at = ["scale.rising.276"]
    with pytest.raises(WizardAborted):
        run_bench(bench.rig, script, tmp_path)
    (result,) = tmp_path.glob("*.json")
    assert "gains_mode_5" in json.loads(result.read_text())["values"]
    assert not bench.servo.torque_on
    assert bench.servo.registers.get("operating_mode") == 3


def test_a_step_is_on_the_disk_before_the_next_begins(tmp_path: Path) -> None:
    bench = SimulatedBench()
    script, files, read = person(bench, "registers"), tmp_path.glob("*.json"), list[str]()
    script.replies["velocity.begin"] = lambda: read.extend(map(Path.read_text, files))
    run_bench(bench.rig, script, tmp_path)
    assert "gains_mode_5" in read[0]


@pytest.mark.parametrize(("rising_a_nm", "step"), [(0.7, "`measured`"), (500.0, "readings")])
def test_a_torque_far_from_the_model_is_checked_before_it_is_used(rising_a_nm, step) -> None:
    assert step in findings(XM430_W350, {"rising_a_nm": rising_a_nm})[0]


def test_limits_stand_beside_the_write() -> None:
    rig = SimulatedBench().rig
    for command in (
        lambda: rig.current(1.01 * rig.most_a),
        lambda: rig.velocity(3.0),
        lambda: rig.pwm(rig.most_pwm_raw + 1),
        lambda: rig.position(rig.sample().position_pulses + 2000),
    ):
        with pytest.raises(StepFailed, match="beyond the"):
            command()


def test_a_hot_servo_ends_its_step(tmp_path: Path) -> None:
    bench = SimulatedBench()
    bench.motor.temperature_c = 65.0
    run_bench(bench.rig, script := person(bench, "velocity"), tmp_path)
    assert any("let it cool" in line for line in script.said)
    assert not bench.servo.torque_on


@pytest.mark.parametrize(
    ("n_servos", "torque", "refused"),
    [(1, 0, None), (2, 0, "several servos answer"), (1, 1, "has torque")],
)
def test_one_servo_alone_and_without_torque(tmp_path, n_servos, torque, refused) -> None:
    bench = SimulatedBench(n_servos=n_servos)
    bench.servo.set_torque(on=bool(torque))
    lines = Bench(tmp_path, bench)
    script = Script(replies={"servo.press": "-1"})
    if refused is None:
        with open_rig(lines, "/dev/ttyUSB0", script) as rig:
            assert (rig.servo_id, rig.model, rig.press) == (1, XM430_W350, -1)
        return
    with pytest.raises(StepFailed, match=refused), open_rig(lines, "/dev/ttyUSB0", script):
        pass


def test_the_config_takes_the_result_of_the_same_model_alone(tmp_path: Path) -> None:
    bench = SimulatedBench()
    _, result = run_bench(bench.rig, person(bench, "scale"), tmp_path)
    drive = measured_drive(result, XM430_W350)
    catalogue = DriveCharacteristic.catalogue(XM430_W350)
    assert drive.load_sd < catalogue.load_sd
    assert drive.coulomb_a == catalogue.coulomb_a, "that step was left out"
    with pytest.raises(ConfigError, match="is of a XM430-W350, this servo is a XL330-M288"):
        measured_drive(result, XL330_M288)
    with pytest.raises(ConfigError, match="no such file"):
        measured_drive(tmp_path / "none.json", XM430_W350)
    result.write_text(result.read_text().replace("rising_a_nm", "rising_a_nn"))
    with pytest.raises(ConfigError, match="damaged"):
        measured_drive(result, XM430_W350)
    write_json(result, SERVO_BENCH, {"model": "XM430-W350", "values": {}}, error=ConfigError)
    with pytest.raises(ConfigError, match="has no values: repeat"):
        measured_drive(result, XM430_W350)
