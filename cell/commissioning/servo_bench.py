"""A servo on a bench, measured with an arm and a kitchen scale: motions, fits, protocol, result.

Fits are pure functions on arrays; times in s, angles in rad, currents in A, torques in N m.
"""

import csv
import io
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from functools import partial
from math import exp, inf
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from cell.commissioning.bench import Bench
from cell.commissioning.engine import Dialog, StepFailed
from cell.commissioning.servos import lone_servo
from cell.errors import CellError, raised_as
from cell.files import SERVO_BENCH, free_name, write_json, write_text
from gripper.clock import Clock
from gripper.dynamixel.bus import ServoBus
from gripper.dynamixel.control_table import PRESENT_BLOCK, REGISTERS, TICK_MODULO, WATCHDOG_UNIT_S
from gripper.dynamixel.drive import DriveCharacteristic
from gripper.dynamixel.models import OperatingMode, ServoModel
from gripper.errors import GripperError

_PERIOD_S = 0.005
"""Time in s between two readings."""
_BOOT_S = 1.0
"""Wait in s after a reboot of a servo that has tripped."""
HOTTEST_C = 60.0
"""Temperature in degC at which a step ends: the registers of servos allow 70 to 80."""
MOST_SHARE = 0.45
"""Largest current of the bench over the stall current."""
_FASTEST_RAD_S = 2.5
"""Largest commanded speed in rad/s."""
_FARTHEST_PULSES = 1200
"""Largest distance in pulses of a goal from the position at which it is set."""
_GIVES_PULSES = 100
"""Longest way in pulses of an arm on the scale, 9 degrees: else nothing limits its speed."""


class Reading(NamedTuple):
    """Registers 120 to 146 of the servo at one time, and its goal: one row of the log."""

    step: str
    part: str
    """Step of the protocol, and its part, for example the commanded current."""
    t_s: float
    """Time by the servo's tick in s."""
    goal_pulses: int
    position_pulses: int
    velocity_rad_s: float
    """Present Velocity, which is late."""
    current_a: float
    """Present Current as the register has it: of the winding, or of the supply."""
    pwm_share: float
    """Present PWM over the whole, -1 to 1."""
    voltage_v: float
    temperature_c: float


def _check(value: float, most: float, unit: str) -> None:
    """Raise StepFailed for a command beyond the limit of the bench."""
    if abs(value) > most:
        raise StepFailed(f"{value:g} {unit} is beyond the {most:g} of the bench")


def records(rows: Sequence[Reading]) -> Any:
    """Return readings as a NumPy record array."""
    return np.rec.fromrecords(rows, formats=None, names=",".join(Reading._fields))


class Rig:
    """One servo on the bench; nothing else writes to it. Its torque is off between two steps."""

    def __init__(self, bus: ServoBus, servo_id: int, model: ServoModel, clock: Clock) -> None:
        self.bus = bus
        self.servo_id = servo_id
        self.model = model
        self.clock = clock
        self.log: list[Reading] = []
        """All readings so far."""
        self.step = ""
        """Name of the running step."""
        self.press = 1
        """Sign of the positions towards the scale."""
        self._goal_pulses = 0
        self._scale_pulses: int | None = None
        self._tick_ms: int | None = None
        self._t_s = 0.0

    @property
    def most_a(self) -> float:
        """Largest current in A that the bench commands."""
        return MOST_SHARE * self.model.stall_current_a

    def read(self, name: str) -> int:
        """Return the raw value of an item of the control table."""
        return self.bus.read(self.servo_id, REGISTERS[name])

    def write(self, **items: int) -> None:
        """Write raw values of items; goals have methods of their own, with their limits."""
        for name, raw in items.items():
            self.bus.write(self.servo_id, REGISTERS[name], raw)

    @contextmanager
    def running(self, step: str) -> Iterator[None]:
        """Run a step; at its end the torque is off, the watchdog disarmed, the mode as before.

        A servo that has tripped is rebooted first.
        """
        self.step = step
        if self.read("hardware_error_status"):
            self.bus.reboot(self.servo_id)
            self.clock.sleep(_BOOT_S)
        mode = self.read("operating_mode")
        try:
            yield
        finally:
            for item in ({"torque_enable": 0}, {"bus_watchdog": 0}, {"operating_mode": mode}):
                with suppress(GripperError):
                    self.write(**item)

    def start(self, mode: OperatingMode, *, on_scale: bool = False, **gains: int) -> None:
        """Set a mode with goals that move nothing and given gains, and switch the torque on.

        ``on_scale``: the arm stands on the scale; `sample` raises StepFailed where it leaves it.
        """
        self._scale_pulses = None
        self.write(torque_enable=0, operating_mode=mode, position_i_gain=0, **gains)
        self.current(0.0)
        self.velocity(0.0)
        if mode is OperatingMode.PWM:
            self.pwm(0)
        self.position(self.sample().position_pulses)
        self._scale_pulses = self._goal_pulses if on_scale else None
        self.write(torque_enable=1)

    def current(self, current_a: float) -> None:
        """Set Goal Current in A of the register, within the limit of the bench."""
        _check(current_a, self.most_a, "A")
        self.write(goal_current=round(current_a / self.model.current_unit_a))

    @property
    def most_pwm_raw(self) -> int:
        """Largest PWM in counts that the bench commands."""
        return int(MOST_SHARE * self.model.whole_pwm_raw)

    def pwm(self, raw: int) -> None:
        """Set Goal PWM in counts, within the limit of the bench."""
        _check(raw, self.most_pwm_raw, "counts of PWM")
        self.write(goal_pwm=raw)

    def velocity(self, velocity_rad_s: float) -> None:
        """Set Goal Velocity in rad/s, within the limit of the bench."""
        _check(velocity_rad_s, _FASTEST_RAD_S, "rad/s")
        self.write(goal_velocity=round(velocity_rad_s / self.model.velocity_unit_rad_s))

    def position(self, pulses: int) -> None:
        """Set Goal Position in pulses, at most `_FARTHEST_PULSES` away, without a profile."""
        _check(pulses - self.sample().position_pulses, _FARTHEST_PULSES, "pulses away")
        self.write(profile_velocity=0, goal_position=pulses)
        self._goal_pulses = pulses

    def sample(self, part: str = "") -> Reading:
        """Read the servo once. Raises StepFailed when it is too hot, or leaves the scale."""
        raw = self.bus.sync_read([self.servo_id], PRESENT_BLOCK)[self.servo_id]
        tick_ms, model = raw["realtime_tick"], self.model
        if self._tick_ms is not None:
            self._t_s += 1e-3 * ((tick_ms - self._tick_ms) % TICK_MODULO)
        self._tick_ms = tick_ms
        reading = Reading(
            step=self.step,
            part=part,
            t_s=self._t_s,
            goal_pulses=self._goal_pulses,
            position_pulses=raw["present_position"],
            velocity_rad_s=raw["present_velocity"] * model.velocity_unit_rad_s,
            current_a=raw["present_current"] * model.current_unit_a,
            pwm_share=raw["present_pwm"] / model.whole_pwm_raw,
            voltage_v=raw["present_input_voltage"] * model.voltage_unit_v,
            temperature_c=float(raw["present_temperature"]),
        )
        self.log.append(reading)
        if reading.temperature_c >= HOTTEST_C:
            limit = f"{reading.temperature_c:.0f} degC, the bench ends at {HOTTEST_C:.0f} degC"
            raise StepFailed(f"the servo has {limit}: let it cool, then run the step again")
        there = self._scale_pulses
        if there is not None and abs(reading.position_pulses - there) > _GIVES_PULSES:
            raise StepFailed("the arm has left the scale: lay its screw on it, check the side")
        return reading

    def watch(
        self, part: str, duration_s: float, until: Callable[[Reading], bool] | None = None
    ) -> Any:
        """Read the servo 200 times a second for a time in s, or until a reading shows the end.

        Returns (n,) readings as a NumPy record array with the fields of `Reading`.
        """
        rows: list[Reading] = []
        start_s = due_s = self.clock.monotonic()
        while due_s - start_s < duration_s:
            rows.append(self.sample(part))
            if until is not None and until(rows[-1]):
                break
            due_s = max(due_s + _PERIOD_S, self.clock.monotonic())
            self.clock.sleep(max(0.0, due_s - self.clock.monotonic()))
        return records(rows)


@contextmanager
def open_rig(bench: Bench, port: str, dialog: Dialog) -> Iterator[Rig]:
    """Find the one servo on a line at any baud rate, and open it for the bench.

    Raises StepFailed unless one servo of a known model answers, without torque.
    """
    rate, servo_id, model = lone_servo(bench, dialog, port)
    if model.ram_shift:
        raise StepFailed(f"a {model.name} is a whole gripper: there is no bench for it")
    with bench.servo_bus(port, rate) as bus:
        rig = Rig(bus, servo_id, model, bench.clock)
        if rig.read("torque_enable"):
            raise StepFailed("the servo has torque, it may hold something: switch its supply off")
        answer = dialog.choose(
            "servo.press",
            "Turn the horn by hand to where the arm presses down on the scale.",
            {"1": "the position grows", "-1": "the position falls"},
            watch=lambda: f"position {rig.sample().position_pulses}",
        )
        rig.press = int(answer)
        yield rig


# Values from readings

Floats = NDArray[np.float64]
_GRID_S = 1e-3
"""Step in s at which positions are interpolated: the resolution of Realtime Tick."""
_WINDOWS_S = tuple(1e-3 * ms for ms in (4, 8, 16, 24, 32, 48, 64, 96, 128))
_LOW_PASSES_S = tuple(1e-3 * ms for ms in (0, 2, 4, 8, 12, 16, 24, 32))
"""Mean and low-pass of Present Velocity that are compared, in s."""
_FEWEST = 3
"""Points of a line and of a check of it."""


def late_velocity(position_rad: Floats, window_s: float, low_pass_s: float) -> Floats:
    """Return mean and low-pass of the velocity in rad/s, of positions each `_GRID_S`."""
    n = max(1, round(window_s / _GRID_S))
    earlier = np.concatenate((np.full(n, position_rad[0]), position_rad[:-n]))
    mean: Floats = (position_rad - earlier) / (n * _GRID_S)
    if low_pass_s <= 0.0:
        return mean
    share = 1.0 - exp(-_GRID_S / low_pass_s)
    late: Floats = lfilter([share], [1.0, share - 1.0], mean)
    return late


def velocity_filter(
    t_s: Floats, position_rad: Floats, velocity_rad_s: Floats
) -> tuple[float, float, float]:
    """Return mean in s, low-pass in s and rms in rad/s of the filter that fits Present Velocity.

    Parameters
    ----------
    t_s, position_rad, velocity_rad_s
        (n,) float64: readings in the order of time, at least 100 a second.
    """
    grid_s = np.arange(t_s[0], t_s[-1], _GRID_S)
    position = np.interp(grid_s, t_s, position_rad)
    best = (0.0, 0.0, inf)
    for window_s in _WINDOWS_S:
        for low_pass_s in _LOW_PASSES_S:
            late = np.interp(t_s, grid_s, late_velocity(position, window_s, low_pass_s))
            rms = float(np.sqrt(np.mean((late - velocity_rad_s) ** 2)))
            if rms < best[2]:
                best = (window_s, low_pass_s, rms)
    return best


def error_gain(error_pulses: Floats, output_raw: Floats, p_gain: float) -> float | None:
    """Return K of output = P error / K, from readings with some output; None without them."""
    asked = error_pulses * p_gain
    used = np.abs(output_raw) >= 10.0
    if not used.any():
        return None
    return float(asked[used] @ asked[used] / (asked[used] @ output_raw[used]))


def slope(x: Sequence[float], y: Sequence[float]) -> float | None:
    """Return the slope of the straight line through points; None with fewer than 3 different x."""
    if len(set(x)) < _FEWEST:
        return None
    return float(np.polyfit(x, y, 1)[0])


def friction(speed_rad_s: Floats, current_a: Floats) -> tuple[float, float, float]:
    """Return Coulomb friction in A, viscous friction in A s/rad and offset in A of free motion.

    ``speed_rad_s``, ``current_a``: (n,) float64, in both directions.
    """
    columns = np.stack((np.sign(speed_rad_s), speed_rad_s, np.ones_like(speed_rad_s)), axis=1)
    (coulomb, viscous, offset), *_ = np.linalg.lstsq(columns, current_a, rcond=None)
    return float(coulomb), float(viscous), float(offset)


# The protocol: six steps of a few minutes, each of which can be left out

ARM_M = 0.1
"""Length in m of the arm from the horn's axis to the screw on the scale."""
_N_PER_G = 9.80665e-3
"""Weight in N of one gram."""
_STEPS, _STEP_PULSES = 10, 200
"""Steps of the goal in free motion, and their size in pulses."""
_OUT_OF_REACH_PULSES = 1000
"""Distance in pulses of a goal that the arm on the scale does not reach."""
_LOAD_SHARES = (0.03, 0.06, 0.12, 0.2, 0.28, 0.36)
"""Currents on the scale over the stall current, in modes with the current of the winding."""
_SUPPLY_SHARES = (0.006, 0.012, 0.02, 0.04, 0.07, 0.11)
"""The same for a servo whose current is that of its supply: 0.16 A of an XL330, below a trip."""
_RAMPED = 20
"""Steps from one of these currents to the next, in 1 s."""
_SPEEDS_RAD_S = (0.1, 0.2, 0.5, 1.0, 2.0)
_COUNT_S = 0.05
"""Time in s of each count of PWM to the first motion."""
_MOVED_PULSES = 5
"""Travel in pulses that counts as motion."""
_PLACES, _PLACE_PULSES = 3, 400
"""Positions of the first motion, and the pulses between two of them."""
_HOT_SHARES = (0.17, 0.26, 0.35, 0.43)
_HOLD_S, _COOL_S = 60.0, 120.0
"""Currents held on the scale over the stall current, the longest time of each in s, and the pause
after it."""
_WATCHDOG_RAW, _SILENT_S = 5, 0.5
"""Time of the watchdog in counts of `WATCHDOG_UNIT_S`, and the silence in s after it."""

Values = dict[str, Any]


def winding_a(rig: Rig, current_a: float, pwm_share: float) -> float:
    """Return the current of the winding in A from that of the register.

    A supply gives its current in the share of the time in which the bridge is on.
    """
    if not rig.model.supply_current:
        return current_a
    return current_a / abs(pwm_share) if abs(pwm_share) > 0.05 else 0.0


def registers(rig: Rig, _dialog: Dialog) -> Values:
    """Read the gains that the firmware sets in both modes.

    A cold servo. It changes between modes 3 and 5 without torque.
    """
    values: Values = {
        "firmware": rig.read("firmware_version"),
        "shutdown_raw": rig.read("shutdown"),
    }
    for mode in (OperatingMode.POSITION, OperatingMode.CURRENT_BASED_POSITION):
        rig.write(operating_mode=mode)
        gains = [rig.read(f"position_{gain}_gain") for gain in "dip"]
        values[f"gains_mode_{int(mode)}"] = gains
    return values


def velocity(rig: Rig, _dialog: Dialog) -> Values:
    """Measure the delay of Present Velocity and the gain of the position loop in free motion.

    Take the arm off: the horn turns freely. It turns by 18 degrees.
    """
    rig.start(OperatingMode.POSITION, position_d_gain=0)
    centre, first = rig.sample().position_pulses, len(rig.log)
    # Away from the ends of the turn, beyond which mode 3 takes no goal.
    away = _STEP_PULSES if centre < rig.model.pulses_per_turn // 2 else -_STEP_PULSES
    for step in range(_STEPS):
        rig.position(centre + (away if step % 2 == 0 else 0))
        rig.watch(f"step {step}", 0.5)
    rows = records(rig.log[first:])
    position_rad = rows.position_pulses * rig.model.rad_per_pulse
    window_s, low_pass_s, rms = velocity_filter(rows.t_s, position_rad, rows.velocity_rad_s)
    # Neither saturated nor on its way at the slope of the PWM.
    below = (np.abs(rows.pwm_share) < 0.9) & (np.abs(np.gradient(rows.pwm_share)) < 0.02)
    error, pwm = rows.goal_pulses - rows.position_pulses, rows.pwm_share * rig.model.whole_pwm_raw
    return {
        "velocity_mean_s": window_s,
        "velocity_low_pass_s": low_pass_s,
        "velocity_rms_rad_s": rms,
        "error_per_pwm": error_gain(error[below], pwm[below], rig.read("position_p_gain")),
    }


def scale(rig: Rig, dialog: Dialog) -> Values:
    """Measure the torque of rising and falling currents with weights.

    Screw the arm on, its screw on the scale, and set the scale to zero. The servo presses on it.
    """
    rig.start(OperatingMode.CURRENT, on_scale=True)
    shares = _SUPPLY_SHARES if rig.model.supply_current else _LOAD_SHARES
    amps = [share * rig.model.stall_current_a for share in shares]
    weighings, last_a = list[tuple[float, ...]](), 0.0
    for current_a in (*amps, *amps[-2::-1]):
        side = "rising" if current_a > last_a else "falling"
        part = f"{side} {current_a:.3f} A"
        # A sudden current would throw the arm, and friction would keep the peak.
        for between_a in np.linspace(last_a, current_a, _RAMPED + 1)[1:]:
            rig.current(rig.press * float(between_a))
            rig.watch(part, 1.0 / _RAMPED)
        last_a = current_a
        rows = rig.watch(part, 1.0)
        if rig.read("hardware_error_status"):
            raise StepFailed(f"the servo has tripped at {current_a:.3f} A: let it cool")
        torque_nm = weighed_nm(rig, dialog, f"scale.{side}.{1e3 * current_a:.0f}", part)
        share, register_a = abs(rows.pwm_share.mean()), abs(rows.current_a.mean())
        motor_a, volts = winding_a(rig, register_a, share), share * rows.voltage_v.mean()
        weighings.append((register_a, motor_a, torque_nm, share, volts))
    names = "register_a,motor_a,torque_nm,pwm_share,winding_v"
    loads: Any = np.rec.fromrecords(weighings, formats=None, names=names)
    rises, most_nm = np.arange(len(loads)) < len(amps), loads.torque_nm[len(amps) - 1]
    # Friction holds the first loads below, and the whole load until the current has fallen enough.
    moves = np.where(rises, loads.torque_nm > 0.1 * most_nm, loads.torque_nm < 0.9 * most_nm)
    rising, falling, every = (loads[moves & of] for of in (rises, ~rises, loads.motor_a > 0.0))
    return {
        "rising_a_nm": slope(rising.torque_nm, rising.motor_a),
        "falling_a_nm": slope(falling.torque_nm, falling.motor_a),
        "winding_ohm": slope(every.motor_a, every.winding_v),
        # V d = R I gives 1 for the current I of the winding, and 1/2 for that of the supply, d I.
        "duty_exponent": slope(np.log(every.register_a), np.log(every.pwm_share)),
    }


def weighed_nm(rig: Rig, dialog: Dialog, key: str, part: str) -> float:
    """Ask for the reading of the scale in g, and return the torque at the horn in N m.

    Raises StepFailed as `Rig.sample`, while the person reads the scale.
    """

    def watch() -> str:
        return f"{rig.sample(part).temperature_c:.0f} degC"

    text, limits = f"{part}: reading of the scale in g?", (-100.0, 20_000.0, "g")
    weight_g = dialog.number(key, text, limits, watch=watch)
    return weight_g * _N_PER_G * ARM_M


def free(rig: Rig, _dialog: Dialog) -> Values:
    """Measure friction, breakaway and back-EMF in free motion.

    Take the arm off: the horn turns freely. It turns both ways.
    """
    rig.start(OperatingMode.VELOCITY)
    points = []
    for goal_rad_s in (sign * speed for speed in _SPEEDS_RAD_S for sign in (1, -1)):
        rig.velocity(goal_rad_s)
        rows = rig.watch(f"{goal_rad_s} rad/s", 1.5)[-150:]
        turned_rad = rows.position_pulses * rig.model.rad_per_pulse
        share = rows.pwm_share.mean()
        motor_a = winding_a(rig, rows.current_a.mean(), share)
        speed_rad_s = np.polyfit(rows.t_s, turned_rad, 1)[0]
        points.append((speed_rad_s, motor_a, share * rows.voltage_v.mean()))
    speeds, currents, volts = np.array(points).T
    coulomb_a, viscous_a_s, offset_a = friction(speeds, currents)
    motor_v = volts - rig.model.winding_ohm * currents
    if rig.model.supply_current:
        # A slow motor takes too little from its supply to be measured; its voltage shows more.
        coulomb_v, v_s, _ = friction(speeds, volts)
        coulomb_a, fastest = coulomb_v / rig.model.winding_ohm, np.abs(speeds).argmax()
        viscous_a_s = max(0.0, (abs(currents[fastest]) - coulomb_a) / abs(speeds[fastest]))
        motor_v = (v_s - rig.model.winding_ohm * viscous_a_s) * speeds
    back_emf_v_s = float(motor_v @ speeds / (speeds @ speeds))
    return {
        "coulomb_a": coulomb_a,
        "viscous_a_s": viscous_a_s,
        "offset_a": offset_a,
        "back_emf_v_s": back_emf_v_s,
        "breakaway_a": _breakaway_a(rig),
    }


def _breakaway_a(rig: Rig) -> float | None:
    """Return the mean current of the winding in A at which the free horn begins to move."""
    currents_a = []
    for place in range(_PLACES):
        for sign in (1, -1):
            rig.start(OperatingMode.PWM)
            rig.watch("at rest", 0.5)
            moved = partial(_moved, rig.sample().position_pulses)
            for raw in range(rig.most_pwm_raw):
                rig.pwm(sign * raw)
                last = rig.watch(f"first motion {place}", _COUNT_S, moved)[-1]
                if moved(last):
                    volts = raw / rig.model.whole_pwm_raw * last.voltage_v
                    currents_a.append(volts / rig.model.winding_ohm)
                    break
        rig.start(OperatingMode.EXTENDED_POSITION)
        rig.position(rig.sample().position_pulses + _PLACE_PULSES)
        rig.watch("next place", 0.5)
    return sum(currents_a) / len(currents_a) if currents_a else None


def _moved(start_pulses: int, row: Reading) -> bool:
    return abs(row.position_pulses - start_pulses) >= _MOVED_PULSES


def _press(rig: Rig, current_a: float) -> None:
    """Press on the scale with a current in A, in mode 5."""
    rig.start(OperatingMode.CURRENT_BASED_POSITION, on_scale=True)
    rig.current(current_a)
    rig.position(rig.sample().position_pulses + rig.press * _OUT_OF_REACH_PULSES)


def heat(rig: Rig, dialog: Dialog) -> Values:
    """Hold currents on the scale until the servo trips, or for a minute each.

    Screw the arm on, its screw on the scale. The servo presses on it, gets hot and may trip.
    """
    trips: dict[str, dict[str, float | None]] = {}
    half = 0.5 if rig.model.supply_current else 1.0
    for current_a in (half * share * rig.model.stall_current_a for share in _HOT_SHARES):
        _press(rig, current_a)
        rig.clock.sleep(_COUNT_S)  # Present PWM is late
        rows = rig.watch(f"hold {current_a:.2f} A", _HOLD_S, lambda row: not row.pwm_share)
        tripped = bool(rig.read("hardware_error_status")) or not rig.read("torque_enable")
        rig.write(torque_enable=0)
        held_s = float(rows.t_s[-1] - rows.t_s[0])
        trips[f"{current_a:.2f}"] = {"trip_s": held_s if tripped else None}
        if tripped:
            rig.bus.reboot(rig.servo_id)
        for left_s in np.arange(_COOL_S, 0.0, -1.0):
            dialog.live("cooling", f"{left_s:.0f} s")
            rig.clock.sleep(1.0)
    return {"held": trips}


def watchdog(rig: Rig, dialog: Dialog) -> Values:
    """Compare the force on the scale before and after a silence of the bus.

    The arm must be fixed, and its screw must touch the scale. Set the scale to zero. The servo
    presses on it.
    """
    _press(rig, (0.07 if rig.model.supply_current else 0.1) * rig.model.stall_current_a)
    rig.watch("before the silence", 1.0)
    before_nm = weighed_nm(rig, dialog, "watchdog.before", "before the silence")
    rig.write(bus_watchdog=_WATCHDOG_RAW)
    rig.clock.sleep(_SILENT_S + _WATCHDOG_RAW * WATCHDOG_UNIT_S)
    values: Values = {
        f"{name}_after_silence": rig.read(name)
        for name in ("torque_enable", "bus_watchdog", "goal_current")
    }
    after_nm = weighed_nm(rig, dialog, "watchdog.after", "after the silence")
    return values | {"held_share": after_nm / before_nm if before_nm > 0.0 else None}


STEPS: dict[Callable[[Rig, Dialog], Values], tuple[str, int]] = {
    registers: ("Registers", 1),
    velocity: ("Velocity register", 3),
    scale: ("Torque", 12),
    free: ("Friction and back-EMF", 8),
    heat: ("Overload and heat", 14),
    watchdog: ("Silence", 2),
}
"""Title and usual time in minutes of the steps in their order, a cold servo first. Each returns
values by name, None for what its readings do not show. Its docstring has the set-up by hand and
the motion that follows; its name is in the log."""


# The result: a log, a file with the values, and their comparison with the model


def findings(model: ServoModel, values: Values) -> list[str]:
    """Return the lines of the result: each number with the model's, and what else was found."""
    drive = DriveCharacteristic.catalogue(model)
    use = "use `measured` in the config"
    ratio = f"{use}, or the force is off by this ratio"
    # Name, value of the model, share by which it may differ, and what a larger difference means.
    rows = (
        ("error_per_pwm", model.error_per_pwm, 0.03, "the goal's lead of this model is wrong"),
        ("winding_ohm", model.winding_ohm, 0.2, "the winding was warm, or the model is wrong"),
        ("rising_a_nm", drive.rising_a_nm, 0.15, ratio),
        ("falling_a_nm", drive.falling_a_nm, 0.3, ratio),
        ("back_emf_v_s", model.back_emf_v_s, 0.15, "checks of the encoder by the motor are off"),
        ("coulomb_a", drive.coulomb_a, 0.5, use),
        ("breakaway_a", drive.breakaway_a, 0.5, use),
    )
    lines = []
    for name, of_model, within, consequence in rows:
        if (measured := values.get(name)) is not None:
            difference = abs(measured - of_model) / of_model
            far = consequence == ratio and difference > 0.5
            advice = (
                "look at arm (100 mm), readings (g), horn and supply first" if far else consequence
            )
            verdict = "agrees" if difference <= within else f"differs: {advice}"
            lines.append(f"{name}: model {of_model:.4g}, measured {measured:.4g}, {verdict}")
    if (gains := values.get("gains_mode_5")) is not None:
        lines.append(f"gains that mode 5 sets by itself (D, I, P): {gains}")
    if (window_s := values.get("velocity_mean_s")) is not None:
        delay_s = 0.5 * window_s + values["velocity_low_pass_s"]
        lines.append(
            f"Present Velocity is {1e3 * delay_s:.0f} ms late; positions measure the motion"
        )
    if (exponent := values.get("duty_exponent")) is not None:
        by_supply = exponent < 0.75
        whose = "supply" if by_supply else "winding"
        line = f"the current registers are those of the {whose} (PWM ~ current^{exponent:.2f})"
        if by_supply != model.supply_current:
            line += ", unlike its model: do not use this servo, and report its firmware"
        lines.append(line)
    for name, held in values.get("held", {}).items():
        end = "held" if (s := held["trip_s"]) is None else f"tripped after {s:.0f} s: a part drops"
        lines.append(f"{name} A on the scale: {end}")
    if (share := values.get("held_share")) is not None:
        lines.append(
            f"after the watchdog tripped it holds {100.0 * share:.0f} % of the force"
            + ("" if share > 0.5 else ": a part drops when the host dies")
        )
    return lines


def run_bench(rig: Rig, dialog: Dialog, folder: Path) -> tuple[Path, ...]:
    """Run the steps that the person wants, and write log and result; return their paths.

    A step that fails, or an abort, keeps what was measured before. Raises CellError if the files
    cannot be written.
    """
    values: Values = {}
    done: list[str] = []
    with raised_as(CellError, OSError, where=f"cannot make the folder {folder}"):
        folder.mkdir(parents=True, exist_ok=True)
    log = folder / f"servo-bench-{rig.model.name.lower()}-id{rig.servo_id}.csv"
    if log.exists() or log.with_suffix(".json").exists():
        log = free_name(log)
    _write(rig, values, done, log)  # a full disk ends it before an hour of measurements
    try:
        for number, (step, (title, minutes)) in enumerate(STEPS.items(), start=1):
            key, text = step.__name__, " ".join((step.__doc__ or "").split())
            answer = dialog.choose(
                f"{key}.begin",
                f"{number}/{len(STEPS)} {title} (about {minutes} min)\n{text}",
                {"run": "ready: run the step", "leave": "leave the step out"},
                "run",
            )
            if answer == "leave":
                continue
            try:
                with rig.running(key):
                    results = step(rig, dialog)
                values |= {name: value for name, value in results.items() if value is not None}
                done.append(key)
                _write(rig, values, done, log)  # a power failure later loses no step
            except (StepFailed, GripperError) as why:
                dialog.say(f"{title} failed: {why}")
    finally:
        for line in findings(rig.model, values):
            dialog.say(line)
        files = _write(rig, values, done, log)
    return files


def _write(rig: Rig, values: Values, done: Sequence[str], log: Path) -> tuple[Path, ...]:
    text = io.StringIO()
    writer = csv.writer(text)
    writer.writerow(Reading._fields)
    writer.writerows(rig.log)
    write_text(log, text.getvalue(), error=CellError, what="log of the bench")
    result = log.with_suffix(".json")
    content = {
        "model": rig.model.name,
        "at": datetime.now(UTC).isoformat(timespec="seconds"),
        "steps": done,
        "values": values,
    }
    write_json(result, SERVO_BENCH, content, error=CellError)
    return log, result
