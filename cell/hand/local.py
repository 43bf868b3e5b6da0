"""The hand in this process: its loop runs in the thread that commands it."""

from collections.abc import Callable

from cell.hand.interface import HandStatistics, Watch
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
from tactile.errors import ZeroDrifted
from tactile.frames.codec import TactileFrame
from tactile.layout import TaxelLayout
from tactile.sensor.sensor import ForceCentres, TactileReading, TactileSensor
from tactile.unit.link import TactileLink
from tactile.unit.settings import NodeIdentity


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
        """Take in what has arrived and return the newest force; see `ForceSensor`."""
        if not self.running:
            return None
        self._new.extend(self._sensor.poll())
        reading = self._sensor.latest
        zero = self._sensor.tare_result
        if reading is None or (zero is not None and reading.frame.t_s <= zero.t_s):
            # What was measured against an earlier zero is no force of this one.
            return None
        if self._sample is None or reading.frame.t_s != self._sample.t_s:
            left, right = reading.finger_force_n
            self._sample = ForceSample(
                t_s=reading.frame.t_s,
                force_n=(float(left), float(right)),
                valid=reading.ok,
                reason=reading.reason,
                centre_m=self._centres.of(reading.force_n),
            )
        return self._sample

    def take(self) -> list[TactileFrame]:
        """Return the frames since the last call, oldest first."""
        taken, self._new = self._new, []
        return [reading.frame for reading in taken]


class LocalHand:
    """Implements `cell.hand.interface.Hand` in the caller's thread.

    Parameters
    ----------
    gripper, sensor, tap
        Gripper, sensor, and the tap through which the one asks the other.
    bus, link
        Their links, for statistics.
    close_links
        Closes both ports.
    notes
        Messages for the operator on how the loop runs.

    Attributes
    ----------
    gripper, sensor, bus, link
        The parts, for tests and benchmarks; commands go through the hand.
    """

    def __init__(
        self,
        *,
        gripper: Gripper,
        sensor: TactileSensor,
        tap: SensorTap,
        bus: ServoBus,
        link: TactileLink,
        close_links: Callable[[], None],
        notes: tuple[str, ...] = (),
    ) -> None:
        self.gripper = gripper
        self.sensor = sensor
        self.bus = bus
        self.link = link
        self.notes = notes
        self._tap = tap
        self._close_links = close_links

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
        """Start the tactile link; see `Hand`."""
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
        self.gripper.tick(self._aim)
        self._tap.latest_force()
        self._tap.take()

    def keep_grip(self) -> None:
        """Freeze in any state; see `Gripper.keep_grip`."""
        self.gripper.keep_grip()

    def clear_fault(self, *, reboot: bool) -> None:
        """Acknowledge a fault of the servos; see `Gripper.clear_fault`."""
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
        self._close_links()

    def _observer(self, watch: Watch) -> Callable[[Cycle], None]:
        def observe(cycle: Cycle) -> None:
            self._aim(cycle)
            watch(cycle, self._tap.take())

        return observe

    def _aim(self, cycle: Cycle) -> None:
        self.sensor.aim(cycle.setpoint_n, cycle.state.aperture_m)

    def _check_zero(self) -> None:
        """Refuse to measure with a zero that has moved; the fingers are open now."""
        if self._tap.running:
            self.sensor.check_zero()
