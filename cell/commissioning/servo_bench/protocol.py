"""The protocol of the bench: six steps of a few minutes, each of which can be left out."""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from cell.commissioning.engine import Dialog, StepFailed
from cell.commissioning.servo_bench import fits
from cell.commissioning.servo_bench.rig import Reading, Rig, records
from gripper.dynamixel.control_table import WATCHDOG_UNIT_S
from gripper.dynamixel.models import OperatingMode

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


class BenchStep(NamedTuple):
    """One step of the protocol."""

    run: Callable[[Rig, Dialog], Values]
    """Measures; returns values by name, None for what its readings do not show. Its docstring tells
    the person the set-up by hand and the motion that follows."""
    title: str
    minutes: int
    """Heading and usual time."""

    @property
    def key(self) -> str:
        """Name in the log."""
        return self.run.__name__

    @property
    def text(self) -> str:
        """What the step measures, and its set-up, for the person."""
        return " ".join((self.run.__doc__ or "").split())


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
    window_s, low_pass_s, rms = fits.velocity_filter(rows.t_s, position_rad, rows.velocity_rad_s)
    # Neither saturated nor on its way at the slope of the PWM.
    below = (np.abs(rows.pwm_share) < 0.9) & (np.abs(np.gradient(rows.pwm_share)) < 0.02)
    error, pwm = rows.goal_pulses - rows.position_pulses, rows.pwm_share * rig.model.whole_pwm_raw
    return {
        "velocity_mean_s": window_s,
        "velocity_low_pass_s": low_pass_s,
        "velocity_rms_rad_s": rms,
        "error_per_pwm": fits.error_gain(error[below], pwm[below], rig.read("position_p_gain")),
    }


class _Load(NamedTuple):
    """One weighing: currents in A, torque in N m, PWM as a share, voltage of the winding in V."""

    register_a: float
    motor_a: float
    torque_nm: float
    pwm_share: float
    winding_v: float


def scale(rig: Rig, dialog: Dialog) -> Values:
    """Measure the torque of rising and falling currents with weights.

    Screw the arm on, its screw on the scale, and set the scale to zero. The servo presses on it.
    """
    rig.start(OperatingMode.CURRENT)
    shares = _SUPPLY_SHARES if rig.model.supply_current else _LOAD_SHARES
    amps = [share * rig.model.stall_current_a for share in shares]
    sides: dict[str, list[_Load]] = {"rising": [], "falling": []}
    last_a = 0.0
    for side, currents in (("rising", amps), ("falling", amps[-2::-1])):
        for current_a in currents:
            part = f"{side} {current_a:.3f} A"
            # A sudden current would throw the arm, and friction would keep the peak.
            for between_a in np.linspace(last_a, current_a, _RAMPED + 1)[1:]:
                rig.current(rig.press * float(between_a))
                rig.watch(part, 1.0 / _RAMPED)
            last_a = current_a
            rows = rig.watch(part, 1.0)
            if rig.read("hardware_error_status"):
                raise StepFailed(f"the servo has tripped at {current_a:.3f} A: let it cool")
            torque_nm = weighed_nm(dialog, f"scale.{side}.{1e3 * current_a:.0f}", part)
            share, register_a = abs(rows.pwm_share.mean()), abs(rows.current_a.mean())
            motor_a, volts = winding_a(rig, register_a, share), share * rows.voltage_v.mean()
            sides[side].append(_Load(register_a, motor_a, torque_nm, share, volts))
    most_nm = sides["rising"][-1].torque_nm
    # Friction holds the first loads below, and the whole load until the current has fallen enough.
    rising = [one for one in sides["rising"] if one.torque_nm > 0.1 * most_nm]
    falling = [one for one in sides["falling"] if one.torque_nm < 0.9 * most_nm]
    every = [one for one in (*rising, *falling) if one.motor_a > 0.0]
    return {
        "rising_a_nm": fits.slope([r.torque_nm for r in rising], [r.motor_a for r in rising]),
        "falling_a_nm": fits.slope([f.torque_nm for f in falling], [f.motor_a for f in falling]),
        "winding_ohm": fits.slope([one.motor_a for one in every], [one.winding_v for one in every]),
        "duty_exponent": fits.exponent(
            [one.register_a for one in every], [one.pwm_share for one in every]
        ),
    }


def weighed_nm(dialog: Dialog, key: str, part: str) -> float:
    """Ask for the reading of the scale in g, and return the torque at the horn in N m."""
    weight_g = dialog.number(key, f"{part}: reading of the scale in g?", (-100.0, 20_000.0, "g"))
    return weight_g * _N_PER_G * ARM_M


def free(rig: Rig, _dialog: Dialog) -> Values:
    """Measure friction, breakaway and back-EMF in free motion.

    Take the arm off: the horn turns freely. It turns both ways.
    """
    rig.start(OperatingMode.VELOCITY)
    points = []
    for speed_rad_s in (sign * speed for speed in _SPEEDS_RAD_S for sign in (1, -1)):
        rig.velocity(speed_rad_s)
        rows = rig.watch(f"{speed_rad_s} rad/s", 1.5)[-150:]
        turned_rad = rows.position_pulses * rig.model.rad_per_pulse
        share = rows.pwm_share.mean()
        motor_a = winding_a(rig, rows.current_a.mean(), share)
        points.append((fits.line(rows.t_s, turned_rad)[0], motor_a, share * rows.voltage_v.mean()))
    speeds, currents, volts = np.array(points).T
    coulomb_a, viscous_a_s, offset_a = fits.friction(speeds, currents)
    motor_v = volts - rig.model.winding_ohm * currents
    if rig.model.supply_current:
        # A slow motor takes too little from its supply to be measured; its voltage shows more.
        coulomb_v, v_s, _ = fits.friction(speeds, volts)
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
    rig.start(OperatingMode.CURRENT_BASED_POSITION)
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
    """Send nothing to a servo that presses on the scale, and see what it does.

    Screw the arm on, its screw on the scale, and set the scale to zero. The servo presses on it.
    """
    _press(rig, (0.07 if rig.model.supply_current else 0.1) * rig.model.stall_current_a)
    rig.watch("before the silence", 1.0)
    before_nm = weighed_nm(dialog, "watchdog.before", "before the silence")
    rig.write(bus_watchdog=_WATCHDOG_RAW)
    rig.clock.sleep(_SILENT_S + _WATCHDOG_RAW * WATCHDOG_UNIT_S)
    values: Values = {
        f"{name}_after_silence": rig.read(name)
        for name in ("torque_enable", "bus_watchdog", "goal_current")
    }
    after_nm = weighed_nm(dialog, "watchdog.after", "after the silence")
    return values | {"held_share": after_nm / before_nm if before_nm > 0.0 else None}


STEPS = (
    BenchStep(registers, "Registers", 1),
    BenchStep(velocity, "Velocity register", 3),
    BenchStep(scale, "Torque", 12),
    BenchStep(free, "Friction and back-EMF", 8),
    BenchStep(heat, "Overload and heat", 14),
    BenchStep(watchdog, "Silence", 2),
)
"""The steps in their order: a cold servo first."""
