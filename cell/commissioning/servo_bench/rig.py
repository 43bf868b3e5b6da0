"""The servo on the bench: its motions within limits, and the log of its readings."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any, NamedTuple

import numpy as np

from cell.commissioning.bench import Bench
from cell.commissioning.engine import Dialog, StepFailed
from cell.commissioning.servos import lone_servo
from gripper.clock import Clock
from gripper.dynamixel.bus import ServoBus
from gripper.dynamixel.control_table import PRESENT_BLOCK, REGISTERS, TICK_MODULO
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
    names = ",".join(Reading._fields)
    return np.rec.fromrecords(rows, formats=None, names=names)


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

    def start(self, mode: OperatingMode, **gains: int) -> None:
        """Set a mode with goals that move nothing and given gains, and switch the torque on."""
        self.write(torque_enable=0, operating_mode=mode, position_i_gain=0, **gains)
        self.current(0.0)
        self.velocity(0.0)
        if mode is OperatingMode.PWM:
            self.pwm(0)
        self.position(self.sample().position_pulses)
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

    def position(self, pulses: int, *, profile_raw: int = 0) -> None:
        """Set Goal Position in pulses, at most `_FARTHEST_PULSES` away, and Profile Velocity."""
        _check(pulses - self.sample().position_pulses, _FARTHEST_PULSES, "pulses away")
        self.write(profile_velocity=profile_raw, goal_position=pulses)
        self._goal_pulses = pulses

    def sample(self, part: str = "") -> Reading:
        """Read the servo once. Raises StepFailed when it is too hot."""
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
