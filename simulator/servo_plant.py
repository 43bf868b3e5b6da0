"""What the firmware of a simulated servo sees of its motor."""

from typing import Protocol

from simulator.motor import DriveCommand


class ServoPlant(Protocol):
    """The motor as the firmware sees it; `simulator.motor.ServoMotor` is one."""

    current_a: float
    duty: float
    temperature_c: float
    voltage_v: float
    reference_rad: float
    reference_velocity_rad_s: float
    load_excess_s: float

    @property
    def sensed_rad(self) -> float:
        """Angle that the encoder reports, rad."""
        ...

    @property
    def sensed_velocity_rad_s(self) -> float:
        """Velocity that follows from the encoder, rad/s."""
        ...

    def drive(self, command: DriveCommand) -> None:
        """Take a new command."""
        ...
