"""The hand in this process: its loop runs in the thread that commands it."""

from collections.abc import Callable, Sequence
from math import sqrt

from cell.hand.interface import HandStatistics, Measured, Watch
from cell.hand.lines import Lines
from gripper.dynamixel.bus import ServoBus
from gripper.force.ramp import ForceRamp
from gripper.gripper import Gripper
from gripper.state import (
    Cycle,
    ForceSample,
    GraspOutcome,
    GripperPhase,
    ReleaseReport,
    ServoCondition,
    VerificationReport,
)
from tactile.errors import BusOff, ReceiveLoopDead, ZeroDrifted
from tactile.frames.codec import TactileFrame
from tactile.frames.force_message import ForceMessage, ForceStatus
from tactile.layout import TaxelLayout
from tactile.sensor.sensor import ForceCentres, TactileReading, TactileSensor
from tactile.unit.link import TactileLink
from tactile.unit.settings import NodeIdentity

_MESSAGE_S = 0.0015
"""From a scan to the reception of its message in s: half a scan, the wire, the adapter."""
_FRAME_CENTRE_N_M = 0.0014
"""Noise of a frame's centre of force along one axis times the grip force, in N m: on a box in the
simulated cell 0.3 mm at 3 N, and half as much again, as each frame is in three means."""
_MESSAGE_CENTRE_N_M = 0.0024
"""The same of one force message, of a single scan: 0.4 mm on a ball and 0.7 mm on a cylinder at 3 N
in the simulated cell, 0.3 mm at 8 N."""
_LEAST_FORCE_N = 0.1
"""Grip force in N that a weaker one counts as, so that this noise stays finite."""


class SensorTap:
    """The force sensor that the gripper asks each period; keeps what passes for the recording.

    Implements `gripper.state.ForceSensor` on a `TactileSensor`.
    """

    def __init__(self, sensor: TactileSensor) -> None:
        self._sensor = sensor
        self._new: list[TactileReading] = []
        self._centres = ForceCentres(sensor.layout)
        self._sample: ForceSample | None = None
        self.running = False
        """Whether the sensor was started; without it there is no force, and none is asked for."""

    def latest_force(self) -> ForceSample | None:
        """Take in what has arrived and return the newest force; see `ForceSensor`.

        It is the mean of the force messages since the last call, or from the newest frame where
        the unit sends none.
        """
        if not self.running:
            return None
        self._new.extend(self._sensor.poll())
        messages = self._sensor.take_forces()
        reading = self._sensor.latest
        zero = self._sensor.tare_result
        if reading is None or (zero is not None and reading.frame.t_s <= zero.t_s):
            # What was measured against an earlier zero is no force of this one.
            return None
        if not self._sensor.has_forces:
            if self._sample is None or reading.frame.t_s > self._sample.t_s:
                self._sample = self._from_frame(reading)
        elif messages:
            self._sample = self._from_messages(messages, reading)
        return self._sample

    def _from_frame(self, reading: TactileReading) -> ForceSample:
        left, right = reading.finger_force_n
        return ForceSample(
            t_s=reading.frame.t_s,
            force_n=(float(left), float(right)),
            valid=reading.ok,
            reason=reading.reason,
            centre_m=self._centres.of(reading.force_n),
            centre_noise_m=_FRAME_CENTRE_N_M / max(0.5 * (left + right), _LEAST_FORCE_N),
        )

    def _from_messages(
        self, messages: Sequence[ForceMessage], reading: TactileReading
    ) -> ForceSample:
        n, newest = len(messages), messages[-1]
        reason = reading.reason
        for message in messages:
            reason = reason or _objection(message.status)
        first_n = sum(message.force_n[0] for message in messages) / n
        second_n = sum(message.force_n[1] for message in messages) / n
        grip_n = max(0.5 * (first_n + second_n), _LEAST_FORCE_N)
        return ForceSample(
            t_s=newest.t_s,
            force_n=(first_n, second_n),
            valid=not reason,
            reason=reason,
            centre_m=self._centre_m(messages),
            centre_noise_m=_MESSAGE_CENTRE_N_M / grip_n / sqrt(n),
            lag_s=_MESSAGE_S + newest.t_s - sum(message.t_s for message in messages) / n,
            noise_n=self._sensor.scan_noise_n / sqrt(n),
        )

    def _centre_m(self, messages: Sequence[ForceMessage]) -> tuple[float, float] | None:
        """Return the centre of what the messages show, the stronger ones for more, in m."""
        loaded = [
            (max(0.0, sum(message.force_n)), message.centre_taxels)
            for message in messages
            if message.centre_taxels is not None
        ]
        total_n = sum(force_n for force_n, _ in loaded)
        if not total_n > 0.0:
            return None
        pad = self._sensor.layout.pads[self._sensor.layout.gripping_pads[0]]
        along = sum(force_n * centre[0] for force_n, centre in loaded) / total_n
        across = sum(force_n * centre[1] for force_n, centre in loaded) / total_n
        return along * pad.pitch_x_m, across * pad.pitch_y_m

    def take(self) -> list[TactileFrame]:
        """Return the frames since the last call, oldest first."""
        taken, self._new = self._new, []
        return [reading.frame for reading in taken]


def _objection(status: ForceStatus) -> str:
    """Return why the forces of a message with this status are not to be used, empty if they are."""
    if status == ForceStatus.ZEROED:
        return ""
    if not status & ForceStatus.ZEROED:
        return "the control unit has no table or zero for its force messages"
    if status & ForceStatus.CONVERTER_FAULT:
        return "the unit's converter failed its self-test"
    return "a taxel of a gripping pad is saturated" if status & ForceStatus.SATURATED else ""


class LocalHand:
    """Implements `cell.hand.interface.Hand` in the caller's thread.

    Parameters
    ----------
    gripper, sensor, tap
        Gripper, sensor, and the tap through which the one asks the other.
    bus, link
        Their links, for statistics.
    lines
        The ports under them; closed at the end.
    notes
        Messages for the operator on how the loop runs.

    Attributes
    ----------
    gripper, sensor, bus, link
        The parts, for tests and benchmarks; commands go through the hand.
    measured
        As in `Hand`.
    """

    def __init__(
        self,
        *,
        gripper: Gripper,
        sensor: TactileSensor,
        tap: SensorTap,
        bus: ServoBus,
        link: TactileLink,
        lines: Lines,
        notes: tuple[str, ...] = (),
    ) -> None:
        self.gripper = gripper
        self.sensor = sensor
        self.bus = bus
        self.link = link
        self.notes = notes
        self.measured = Measured()
        self._tap = tap
        self._lines = lines

    @property
    def layout(self) -> TaxelLayout:
        """The taxels."""
        return self.sensor.layout

    @property
    def period_s(self) -> float:
        """Period of the loop in s."""
        return self.gripper.period_s

    @property
    def phase(self) -> GripperPhase:
        """What the gripper is doing."""
        return self.gripper.state

    @property
    def sensing(self) -> bool:
        """Whether the tactile link was started."""
        return self._tap.running

    @property
    def statistics(self) -> HandStatistics:
        """Counters of loop and links."""
        return HandStatistics(
            loop=self.gripper.statistics,
            servo_bus=self.bus.statistics,
            link=self.link.statistics,
            sensor=self.sensor.statistics,
        )

    def start(self) -> VerificationReport:
        """Verify the servos; see `Hand`."""
        return self.gripper.start()

    def start_sensor(self) -> NodeIdentity:
        """Start the tactile link, on a bus that is opened anew where it was lost; see `Hand`."""
        if self._lines.can_is_missing or isinstance(self.link.fault, BusOff | ReceiveLoopDead):
            self.link.use(self._lines.reopen_can())
        identity = self.sensor.start()
        self._tap.running = True
        return identity

    def close_sensor(self) -> None:
        """End the tactile link."""
        self._tap.running = False
        self.sensor.close()

    def open(self, watch: Watch) -> None:
        """Open the empty fingers; see `Hand`."""
        self.gripper.open(observer=self._observer(watch))

    def tare(self, n_frames: int) -> None:
        """Take the zero of the taxels; see `Hand`."""
        self.sensor.tare(n_frames)
        # No force is measured before the mean holds frames alone that count from this zero.
        self.sensor.refresh()

    def check_ramp(self, ramp: ForceRamp) -> None:
        """Refuse a ramp beyond the limits; see `Hand`."""
        self.gripper.check_ramp(ramp)

    def grasp(self, ramp: ForceRamp, watch: Watch) -> GraspOutcome:
        """Close and follow the ramp; see `Hand`."""
        self._check_zero()
        self._tap.take()
        return self.gripper.grasp(ramp, observer=self._observer(watch))

    def carry(self, force_n: float, duration_s: float, watch: Watch) -> None:
        """Hold the part with another force; see `Hand`."""
        self._tap.take()
        self.gripper.carry(force_n, duration_s, self._observer(watch))

    def squeeze(self, ramp: ForceRamp, watch: Watch) -> GraspOutcome:
        """Follow a further ramp in the same grip; see `Hand`."""
        self._tap.take()
        return self.gripper.squeeze(ramp, self._observer(watch))

    def end_ramp(self) -> None:
        """Let the running ramp end where it is; see `Hand`."""
        self.gripper.end_ramp()

    def release(self, watch: Watch | None = None) -> ReleaseReport:
        """Let go; see `Hand`."""
        report = self.gripper.release(observer=None if watch is None else self._observer(watch))
        try:
            self._check_zero()
        except ZeroDrifted:
            # The mean may still hold frames from before the fingers had left the part.
            self.sensor.refresh()
            self._check_zero()
        return report

    def conditions(self) -> tuple[ServoCondition, ...]:
        """Read torque and errors of each servo; see `Hand`."""
        return self.gripper.conditions()

    def inspect(self) -> VerificationReport:
        """Compare the servos with the settings; reads only."""
        return self.gripper.inspect()

    def read_sensor(self, timeout_s: float) -> TactileReading:
        """Wait for a new reading of the taxels."""
        return self.sensor.read(timeout_s=timeout_s)

    def tick(self) -> None:
        """Keep both links alive and supervised; see `Hand`."""
        cycle = self.gripper.tick()
        if cycle is not None and cycle.force is not None:
            self._aim(cycle)
        force = self._tap.latest_force()
        self.measured = self.measured.then(cycle, force, self._tap.take())

    def keep_grip(self) -> None:
        """Freeze in any state; see `Gripper.keep_grip`."""
        self.gripper.keep_grip()

    def clear_fault(self, *, reboot: bool) -> None:
        """Acknowledge a fault of the servos, on a port that is opened anew where it was lost."""
        if self._lines.servos_are_missing or self.bus.lost:
            self.bus.use(self._lines.reopen_servos())
        self.gripper.clear_fault(reboot=reboot)

    def request_stop(self) -> None:
        """Let the running command end with GraspStopped."""
        self.gripper.request_stop()

    def shutdown(self) -> str:
        """Leave servos and sensor in a defined state; see `Hand`."""
        self.gripper.close()
        self.close_sensor()
        return ""

    def close(self) -> None:
        """Give the ports back."""
        self._lines.close()

    def _observer(self, watch: Watch) -> Callable[[Cycle], None]:
        def observe(cycle: Cycle) -> None:
            self._aim(cycle)
            frames = self._tap.take()
            self.measured = self.measured.then(cycle, cycle.force, frames)
            watch(cycle, frames)

        return observe

    def _aim(self, cycle: Cycle) -> None:
        self.sensor.aim(cycle.setpoint_n, cycle.state.aperture_m)

    def _check_zero(self) -> None:
        """Refuse to measure with a zero that has moved; the fingers are open now."""
        if self._tap.running:
            self.sensor.check_zero()
