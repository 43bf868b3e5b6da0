"""A servo that turns or shifts the object: motor, load and line."""

from dataclasses import dataclass

from gripper.dynamixel.models import XM430_W350, ServoModel
from simulator.servo.bus import ServoBusDevice
from simulator.servo.device import BAUD_RATES, SimulatedServo
from simulator.servo.mechanics import velocity_after
from simulator.servo.motor import ServoMotor

LOAD_INERTIA_KG_M2 = 2e-4
"""Inertia of the servo's load in kg m²: 0.2 kg at 30 mm; an assumption."""
STEP_S = 1e-3
"""Step of its motion in s."""
_MOVING_RAD_S = 1e-3
"""Speed in rad/s above which it counts as moving."""


@dataclass(frozen=True, slots=True, kw_only=True)
class WristMount:
    """A simulated servo and the axis that it moves."""

    servo_id: int
    model: ServoModel = XM430_W350
    baud_rate: int = 1_000_000
    """ID, model, and rate of its line in bit/s."""
    increments: float
    """Pulses per m or rad of the axis; negative for the other direction."""
    zero: int
    """Present Position at 0 of the axis."""
    start: float
    """True position at power-on in m or rad."""


class SimulatedWrist:
    """One servo with its load, alone on its line; it has no clock, the time is an argument."""

    def __init__(self, mount: WristMount, *, start_s: float = 0.0) -> None:
        self.mount = mount
        angle_rad = (mount.zero + mount.start * mount.increments) * mount.model.rad_per_pulse
        self._motor = ServoMotor(mount.model, angle_rad=angle_rad)
        rate = {"baud_rate": BAUD_RATES.index(mount.baud_rate), "return_delay_time": 0}
        self.servo = SimulatedServo(mount.servo_id, mount.model, self._motor, settings=rate)
        self.bus = ServoBusDevice([self.servo], mount.baud_rate)
        self.blocked = False
        """Fault knob: the axis is blocked."""
        self.slipped = 0.0
        """Fault knob: offset of the axis from the encoder's position in m or rad."""
        self._stepped_s = start_s

    @property
    def position(self) -> float:
        """True position of the axis in m or rad."""
        pulses = self._motor.angle_rad / self.mount.model.rad_per_pulse - self.mount.zero
        return pulses / self.mount.increments + self.slipped

    @property
    def moving(self) -> bool:
        """Whether it turns."""
        return abs(self._motor.velocity_rad_s) > _MOVING_RAD_S

    @property
    def dead(self) -> bool:
        """Fault knob: it receives and answers nothing; its motion goes on."""
        return bool(self.bus.faults.silent)

    @dead.setter
    def dead(self, dead: bool) -> None:
        self.bus.faults.silent = {self.mount.servo_id} if dead else set()

    def fail(self, _code: int) -> None:
        """Use up the overload budget; a servo has no error code of its own."""
        self._motor.overload()

    def power_cycle(self) -> None:
        """Restart: torque off, set-up and turns are lost."""
        self.servo.boot(self._stepped_s)

    def advance(self, now_s: float) -> None:
        """Let the time pass until ``now_s`` s."""
        while self._stepped_s + STEP_S <= now_s + 1e-9:
            self._stepped_s += STEP_S
            self._step()
        self.bus.advance_to(now_s)

    def _step(self) -> None:
        motor = self._motor
        torque_nm = motor.torque_nm(STEP_S)
        motor.velocity_rad_s = (
            0.0
            if self.blocked
            else velocity_after(
                motor.velocity_rad_s,
                STEP_S * torque_nm,
                STEP_S * motor.friction_nm(torque_nm),
                motor.inertia_kg_m2 + LOAD_INERTIA_KG_M2,
                STEP_S * motor.viscous_nm_s,
                breakaway=motor.breakaway,
            )
        )
        motor.angle_rad += motor.velocity_rad_s * STEP_S
