"""The simulated servos against logs of real ones: python -m benchmarks servo_logs FOLDER.

Each log moves the encoder of a simulated servo as the real one moved. Its registers are then held
against the recorded ones: Present Velocity, and in position mode Present PWM. A log of a pendulum
that goes up and down slowly is also simulated: the servo lifts the same weight, and reaches a
similar PWM. Two kinds of files are known, `.npz` of numpy:

- `timestamp`, `position`, `speed`, `goal_position` (s, rad, rad/s, rad), `load` (raw PWM),
  `input_volts`, `torque_enable`, and `meta` as JSON with `motor`, `kp`, `mass` and `length` of the
  pendulum (kg, m), and `trajectory` (Rhoban/bam);
- `t`, and `q1`, `dq1` and so on for each joint (s, rad, rad/s), of XM430-W350
  (smorales2405/open_manipulator_x_torque_control).
"""

import json
import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks._measure import line
from cell.files import DAMAGE
from gripper.dynamixel.models import MODELS, XM430_W350, OperatingMode, ServoModel
from simulator.servo.control_table import is_x330
from simulator.servo.device import SimulatedServo
from simulator.servo.gearing import drawn_drive
from simulator.servo.mechanics import velocity_after
from simulator.servo.motor import ServoMotor

SPEED_RMS_RAD_S = {"430 size": 0.018, "330 size": 0.04}
"""Largest rms difference of Present Velocity by size of servo in rad/s, over all its logs."""
_ENCODER_SHARE = 0.01
"""Error of an encoder that differs by the angle, over the speed: a fast log may differ by it on
top. In the logs of an XL330-M288 above 3 rad/s it is -0.7 to 1.1 %."""
PWM_COUNTS = 3.0
"""Largest median difference of Present PWM in counts."""
PENDULUM_SHARE = 0.15
"""Largest difference of the greatest PWM of a pendulum, as a share."""
_STEP_S = 1e-3
_LONGEST_S, _SETTLED_S = 0.05, 0.2
"""Longest time in s between two samples, with a straight motion between them; and the time from the
start of a log, or the end of a longer gap, until the velocity register is full."""
_MOST_S = 3600.0
"""Longest time in s of a log."""
_LEAST = 100
"""Least samples of a log."""
_GRAVITY_M_S2 = 9.81

Array = NDArray[np.float64]


class BadLog(Exception):
    """A file is no log of a servo."""


class Log(NamedTuple):
    """What one real servo did."""

    name: str
    model: ServoModel
    time_s: Array
    position_rad: Array
    speed_rad_s: Array
    goal_rad: Array | None = None
    """Goal Position; None: the servo was in another mode than position."""
    pwm_raw: Array | None = None
    p_gain: int = 0
    supply_v: float = 0.0
    torque_nm: float = 0.0
    """Largest torque of the weight of a pendulum that goes up and down; 0: no such pendulum."""
    inertia_kg_m2: float = 0.0


def read_logs(path: Path) -> list[Log]:
    """Return the servos of one file. Raises BadLog, with the file and the cause."""
    try:
        with path.open("rb") as opened, np.load(opened, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
            arrays |= {n: a.astype(float) for n, a in arrays.items() if a.dtype.kind in "biuf"}
        if "meta" in arrays:
            meta = dict(json.loads(str(arrays["meta"][()])))
            logs = [_pendulum(path.stem, arrays, meta)]
        else:
            joints = sorted(n[1:] for n in arrays if n[:1] == "q" and n[1:].isdecimal())
            model, stem = _model(path.stem, XM430_W350.name), path.stem
            logs = [
                Log(
                    f"{stem} {joint}", model, arrays["t"], arrays[f"q{joint}"], arrays[f"dq{joint}"]
                )
                for joint in joints or ["1"]
            ]
        for log in logs:
            arrays = [data for data in log if isinstance(data, np.ndarray)]
            if {data.shape for data in arrays} != {(len(log.time_s),)} or len(log.time_s) < _LEAST:
                raise ValueError(f"its arrays are not of one length of {_LEAST} samples or more")
            values = [log.supply_v, log.torque_nm, log.inertia_kg_m2]
            goal_rad = [] if log.goal_rad is None else log.goal_rad
            if (
                np.isinf(goal_rad).any()
                or not np.isfinite([*np.concatenate(arrays[:3]), *values]).all()
            ):
                raise ValueError("a value is no number")
            if np.diff(log.time_s).min() < 0.0 or np.ptp(log.time_s) > _MOST_S:
                raise ValueError(f"its times in s do not grow, or last longer than {_MOST_S:g} s")
    except (*DAMAGE, OSError) as error:
        cause = f"it lacks {error}" if isinstance(error, KeyError) else str(error)
        raise BadLog(f"{path} is no log of a servo: {cause}") from error
    return logs


def _model(stem: str, motor: str) -> ServoModel:
    """Return the model that a file's name begins with, or else the one of its ``motor``."""
    for name in (stem, motor):
        for model in MODELS.values():
            own, known = (x.lower().replace("-", "_") for x in (name, model.name))
            if own.startswith(known) or known.startswith(own):
                return model
    raise ValueError(f"neither its name nor motor {motor!r} is one of {', '.join(MODELS)}")


def _pendulum(stem: str, arrays: dict[str, Array], meta: dict[str, Any]) -> Log:
    raw, mass, length = arrays["load"], meta.get("mass", 0.0), meta.get("length", 0.0)
    slow = meta.get("trajectory") == "up_and_down"
    return Log(
        stem,
        _model(stem, str(meta["motor"])),
        *(arrays[name] for name in ("timestamp", "position", "speed")),
        goal_rad=np.where(arrays["torque_enable"] > 0, arrays["goal_position"], np.nan),
        pwm_raw=np.where(raw > 0x7FFF, raw - 0x10000, raw),
        p_gain=int(meta["kp"]),
        supply_v=float(np.median(arrays["input_volts"])),
        torque_nm=_GRAVITY_M_S2 * mass * length if slow else 0.0,
        inertia_kg_m2=mass * length**2,
    )


class Bench:
    """A simulated servo, with its horn turned as a log says or with the weight of its pendulum."""

    def __init__(self, log: Log) -> None:
        self.motor = ServoMotor(log.model, figures=drawn_drive(log.model, None))
        self.motor.voltage_v = log.supply_v or self.motor.voltage_v
        mode = OperatingMode.CURRENT if log.goal_rad is None else OperatingMode.EXTENDED_POSITION
        settings = {"operating_mode": int(mode)}
        self._core = SimulatedServo(1, log.model, self.motor, settings=settings)
        self._core.registers.put("position_p_gain", log.p_gain)
        self._core.registers.put("position_d_gain", 0)
        self.motor.place(math.pi + float(log.position_rad[0]))
        self._log, self._inertia = log, log.inertia_kg_m2 + self.motor.inertia_kg_m2

    def run(self, *, free: bool = False) -> tuple[Array, Array]:
        """Return Present Velocity in rad/s and Present PWM in counts at the times of the log.

        ``free``: the motor turns the pendulum; else the log turns the motor.
        """
        log, motor, core = self._log, self.motor, self._core
        grid_s = np.arange(log.time_s[0], log.time_s[-1] + _STEP_S, _STEP_S)
        turned_rad = math.pi + np.interp(grid_s, log.time_s, log.position_rad)
        speeds_rad_s = np.diff(turned_rad, append=turned_rad[-1:]) / _STEP_S
        sample = np.minimum(np.searchsorted(log.time_s, grid_s), len(log.time_s) - 1)
        at = np.clip(np.searchsorted(grid_s, log.time_s, side="right") - 1, 0, None)
        read, simulated = set(at.tolist()), np.zeros((2, len(grid_s)))
        for i in range(len(grid_s)):
            if log.goal_rad is not None:
                self._command(float(log.goal_rad[sample[i]]))
            if free:
                self._swing()
            else:
                motor.angle_rad = float(turned_rad[i])
                motor.velocity_rad_s = float(speeds_rad_s[i])
                motor.torque_nm(_STEP_S)
            if i in read:
                core.refresh(i * _STEP_S)
                simulated[0, i] = core.registers.get("present_velocity")
                simulated[1, i] = core.registers.get("present_pwm")
        return simulated[0, at] * log.model.velocity_unit_rad_s, simulated[1, at]

    def _command(self, goal_rad: float) -> None:
        on, model = not math.isnan(goal_rad), self._log.model
        if on:
            goal_raw = round(goal_rad / model.rad_per_pulse) + model.pulses_per_turn // 2
            self._core.registers.put("goal_position", goal_raw)
        self._core.set_torque(on=on)

    def _swing(self) -> None:
        motor, dt_s = self.motor, _STEP_S
        load_nm = -self._log.torque_nm * math.sin(motor.angle_rad - math.pi)
        driving_nm = motor.torque_nm(dt_s)
        motor.velocity_rad_s = velocity_after(
            motor.velocity_rad_s,
            dt_s * (driving_nm + load_nm),
            dt_s * motor.friction_nm(driving_nm, load_nm),
            self._inertia,
            dt_s * motor.viscous_nm_s,
            breakaway=motor.breakaway,
        )
        motor.angle_rad += motor.velocity_rad_s * dt_s


def size(model: ServoModel) -> str:
    """Return the size of a servo, by which its velocity register differs."""
    return "330 size" if is_x330(model) else "430 size"


class Row(NamedTuple):
    """One comparison of one log."""

    name: str
    value: float
    most: float
    unit: str

    @property
    def met(self) -> bool:
        """Whether the value is within its target; NaN is not."""
        return self.value <= self.most

    def __str__(self) -> str:
        mark = "" if self.met else " OUTSIDE"
        return f"{self.name} {self.value:.3g} {self.unit} ({self.most:.3g}){mark}"


def compared(log: Log) -> list[Row]:
    """Return the comparisons of one log, that of the velocity at first."""
    time_s = log.time_s
    begins_s = time_s[np.diff(time_s, prepend=-np.inf) > _LONGEST_S]
    settled = time_s - begins_s[np.searchsorted(begins_s, time_s, "right") - 1] > _SETTLED_S
    if settled.sum() < _LEAST:
        raise BadLog(f"{log.name}: too few of its samples are at most {_LONGEST_S} s apart")
    velocity_rad_s, pwm = Bench(log).run()
    speed, error = log.speed_rad_s[settled], (velocity_rad_s - log.speed_rad_s)[settled]
    most = math.hypot(SPEED_RMS_RAD_S[size(log.model)], _ENCODER_SHARE * _rms(speed))
    rows = [Row("velocity", _rms(error), most, "rad/s")]
    if log.goal_rad is not None and log.pwm_raw is not None:
        # Position and PWM are read one after the other: they belong together where it stands.
        stands = np.abs(np.gradient(log.position_rad)) <= log.model.rad_per_pulse
        differs = np.abs(pwm - log.pwm_raw)[settled & ~np.isnan(log.goal_rad) & stands]
        if differs.size:
            rows.append(Row("PWM", float(np.median(differs)), PWM_COUNTS, "counts"))
        if log.torque_nm:
            real, simulated = (np.abs(x).max() for x in (log.pwm_raw, Bench(log).run(free=True)[1]))
            rows.append(Row("pendulum", abs(simulated / real - 1.0), PENDULUM_SHARE, "of its PWM"))
    return rows


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def main(effort: float = 1.0, folder: str | None = None) -> None:
    """Print a line for each log, and the rms of all logs of a size.

    Ends with status 1 where a log is outside its target, or cannot be read.
    """
    del effort
    if folder is None:
        line("compared", "nothing: name a folder of logs of servos after `servo_logs`")
        return
    paths = sorted(Path(folder).glob("*.npz"))
    if not paths:
        raise SystemExit(f"{folder} has no log: name a folder with files that end in .npz")
    line("compared", f"rms, median and greatest PWM of {len(paths)} files, (largest allowed)")
    outside, squares = 0, dict[str, list[float]]()
    for path in paths:
        try:
            for log in read_logs(path):
                rows = compared(log)
                outside += any(not row.met for row in rows)
                squares.setdefault(size(log.model), []).append(rows[0].value ** 2)
                line(log.name, f"{log.model.name}: {', '.join(map(str, rows))}")
        except BadLog as error:
            outside += 1
            line(path.name, f"ERROR {error}")
    for name, squared in squares.items():
        row = Row("velocity of all", math.sqrt(np.mean(squared)), SPEED_RMS_RAD_S[name], "rad/s")
        outside += not row.met
        line(name, str(row))
    if outside:
        raise SystemExit(1)
