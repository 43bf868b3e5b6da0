"""Feedback of the servos of one gripper in SI, checked for being new and possible."""

from collections.abc import Sequence
from math import pi, tau

from gripper.bus import ServoBus
from gripper.clock import Clock
from gripper.errors import BusCorrupt, BusTimeout
from gripper.freshness import TickWatch
from gripper.goals import WrittenGoals
from gripper.health import ServoHealth
from gripper.kinematics import Linkage, Transmission
from gripper.plausibility import FeedbackCheck
from gripper.registers import (
    PRESENT_TEMPERATURE,
    RAD_PER_PULSE,
    RAD_S_PER_VELOCITY_UNIT,
    REALTIME_TICK,
)
from gripper.settings import GripperSettings, ServoSettings
from gripper.state import GripperState, ServoState

_PATIENT_READS = 3


class Feedback:
    """Reads the servos.

    Parameters
    ----------
    bus, linkage, settings, clock
        Of the gripper.
    goals
        While any is in force the servos are under torque.
    health
        Asked for the torque where a servo seems to have restarted.

    Attributes
    ----------
    last
        What was read last; None before the first reading.
    """

    def __init__(
        self,
        bus: ServoBus,
        linkage: Linkage,
        settings: GripperSettings,
        clock: Clock,
        *,
        goals: WrittenGoals,
        health: ServoHealth,
    ) -> None:
        self.last: GripperState | None = None
        self._bus = bus
        self._linkage = linkage
        self._settings = settings
        self._clock = clock
        self._goals = goals
        self._health = health
        self._ids = [servo.servo_id for servo in settings.servos]
        self._ticks = TickWatch()
        self._plausible = FeedbackCheck(settings, linkage)

    def read(self) -> GripperState:
        """Read the feedback of all servos in one transaction.

        Raises
        ------
        BusTimeout, BusCorrupt
            When an answer is missing, damaged or older than the request.
        ServoFault
            When a servo has restarted under torque.
        FeedbackImplausible
            When a servo under torque reports what cannot be.
        """
        sent_s = self._clock.monotonic()
        raws = self._bus.sync_read(self._ids, REALTIME_TICK, PRESENT_TEMPERATURE)
        now_s = self._clock.monotonic()
        for servo_id, raw in raws.items():
            problem = self._ticks.check(servo_id, raw[REALTIME_TICK.name], sent_s, now_s)
            if problem is not None:
                try:
                    # An old answer has another length: it cannot pass for this one.
                    if self._goals.last:
                        self._health.check_torque(servo_id)
                finally:
                    self._bus.distrust()
                raise problem
        servos = tuple(self._servo_state(s, raws[s.servo_id]) for s in self._settings.servos)
        if self._goals.last:
            self._plausible.check(servos, now_s)
        angles = [servo.angle_rad for servo in servos]
        current_a = sum(abs(servo.current_a) for servo in servos) / len(servos)
        forces_n = [
            path.force_band_n(abs(servo.current_a))[0]
            for path, servo in zip(self.transmissions(servos), servos, strict=True)
        ]
        self.last = GripperState(
            t_s=now_s,
            aperture_m=self._linkage.aperture_m(angles),
            aperture_velocity_m_s=sum(
                self._linkage.opening_per_rad_m(servo.angle_rad) * servo.velocity_rad_s
                for servo in servos
            ),
            current_a=current_a,
            force_from_current_n=sum(forces_n) / len(forces_n),
            temperature_c=max(servo.temperature_c for servo in servos),
            voltage_v=min(servo.voltage_v for servo in servos),
            servos=servos,
        )
        return self.last

    def read_patiently(self) -> GripperState:
        """Read as `read` does, again where an answer was lost or old; for use between commands."""
        for _ in range(_PATIENT_READS - 1):
            try:
                return self.read()
            except (BusTimeout, BusCorrupt):
                continue
        return self.read()

    def _servo_state(self, servo: ServoSettings, raw: dict[str, int]) -> ServoState:
        turned = (raw["present_position"] - servo.zero_raw) * RAD_PER_PULSE * servo.direction
        return ServoState(
            servo_id=servo.servo_id,
            # A multi-turn count may be off by whole turns; fingers move by less than half a turn.
            angle_rad=(turned + pi) % tau - pi,
            velocity_rad_s=raw["present_velocity"] * RAD_S_PER_VELOCITY_UNIT * servo.direction,
            current_a=servo.servo_model.current_a(raw["present_current"]) * servo.direction,
            position_raw=raw["present_position"],
            temperature_c=float(raw["present_temperature"]),
            voltage_v=raw["present_input_voltage"] * 0.1,
            tick_ms=raw[REALTIME_TICK.name],
            alert=self._bus.alert(servo.servo_id),
        )

    def transmissions(self, servos: Sequence[ServoState]) -> tuple[Transmission, ...]:
        """Return the transmission of each servo at its present angle."""
        return tuple(
            Transmission.at(settings.servo_model, self._linkage, servo.angle_rad)
            for settings, servo in zip(self._settings.servos, servos, strict=True)
        )

    @property
    def aperture_m(self) -> float | None:
        """The opening in m as it was read last; None before the first reading."""
        return None if self.last is None else self.last.aperture_m

    def forget(self) -> None:
        """Begin anew: what was read before says nothing about what comes."""
        self._ticks.forget()
        self._plausible.forget()
