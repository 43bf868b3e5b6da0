"""The hand: gripper and tactile sensor as one interface, for a force loop in any process.

`cell.hand.local.LocalHand` runs the loop in this process, in the caller's thread: virtual time and
tests. `cell.hand.client.HandProcess` runs it in its own process: real time.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from gripper.dynamixel.bus import BusStatistics
from gripper.dynamixel.drive import DriveCharacteristic, DriveReport
from gripper.force.ramp import ForceRamp
from gripper.force.timing import LoopStatistics
from gripper.values.force_sensor import ForceSample
from gripper.values.outcome import GraspOutcome, ReleaseReport
from gripper.values.servo_checks import ServoCondition, VerificationReport
from gripper.values.state import Cycle, GripperPhase, TimeSpan
from tactile.layout import TaxelLayout
from tactile.sensor.sensor import SensorStatistics, TactileReading
from tactile.sensor.tare import TareResult
from tactile.source import SourceIdentity, SourceStatistics, TactileFrame

FRESH_S = 0.5
"""Age in s beyond which a value counts as not measured. Frames come every 0.02 s, periods of the
loop every 0.005 s, and a busy machine may delay the program by some tenths of a second."""

OnPeriod = Callable[[Cycle, Sequence[TactileFrame]], None]
"""Callback for each period of a command, in order, with its tactile frames.

An error that it raises stops the command with the grip kept, and is passed on.
"""


FORCE_FROM_FRAMES = (
    "the force comes from whole frames and is slower: the sensor sends no force messages. With a "
    "control unit it has no object 2140h, tactile.force_period_ms is 0, or the two inner pads are "
    "not mounted alike (tactile.mounting). A gripper.approach_speed_mm_s of 12 keeps the impact of "
    "the contact small"
)
"""Note about a sensor that sends no force messages."""


@dataclass(frozen=True, slots=True, kw_only=True)
class HandStatistics:
    """Counters of loop and links."""

    loop: LoopStatistics
    """Timing of the force loop since it was made."""
    servo_bus: BusStatistics
    """Since the servos' port was opened."""
    source: SourceStatistics
    """Of the frames, since the last start of the tactile sensor."""
    sensor: SensorStatistics = field(default_factory=SensorStatistics)
    """Since the last start of the tactile sensor."""
    undelivered: int = 0
    """Periods that this process lost because it read too slowly."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LatestValues:
    """Newest values of a hand, from motions and supervision; None before the first."""

    cycle: Cycle | None = None
    """Newest period in which the servos answered."""
    force: ForceSample | None = None
    """Newest valid force sample."""
    frame: TactileFrame | None = None
    """Newest tactile frame."""

    def then(
        self, cycle: Cycle | None, force: ForceSample | None, frames: Sequence[TactileFrame]
    ) -> "LatestValues":
        """Return the newest values after one more period; its force may be None or invalid."""
        return LatestValues(
            cycle=cycle or self.cycle,
            force=force if force is not None and force.valid else self.force,
            frame=frames[-1] if frames else self.frame,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class LiveValues:
    """The present measurements: in a motion, in a carry, and between two jobs.

    A value is None before the first motion, after a fault or a shutdown, and when it is older than
    `FRESH_S`. Ages are those at the call, by the cell's own clock. In virtual time this clock and
    the fingers stand still between two commands, so values and ages do not change. With
    `tactile-cell serve` the clock follows real time.
    """

    force_n: float | None = None
    """Grip force in N: the mean of both fingers, as the force loop controls it."""
    force_age_s: float | None = None
    """Age of the newest valid force in s, even if the force is too old to be shown."""
    setpoint_n: float | None = None
    """Force set-point in N; 0 while no force is controlled."""
    opening_mm: float | None = None
    """Opening between the fingers in mm."""
    temperature_c: float | None = None
    """Temperature of the warmest servo in degrees Celsius."""
    counts: NDArray[np.uint16] | None = field(default=None, repr=False)
    """(n_taxels,) uint16: raw counts of the newest frame, read-only."""
    frame_age_s: float | None = None
    """Age of the newest frame in s, even if the frame is too old to be shown."""


_Value = TypeVar("_Value", Cycle, ForceSample, TactileFrame)


def live_values(latest: LatestValues, now_s: float) -> LiveValues:
    """Return the values of a hand at a monotonic time in s."""

    def age_s(sample: ForceSample | TactileFrame | None) -> float | None:
        return None if sample is None else max(0.0, now_s - sample.t_s)

    def fresh(value: _Value | None) -> _Value | None:
        return None if value is None or now_s - value.t_s > FRESH_S else value

    cycle, force, frame = fresh(latest.cycle), fresh(latest.force), fresh(latest.frame)
    return LiveValues(
        force_n=None if force is None else force.grip_n,
        force_age_s=age_s(latest.force),
        setpoint_n=None if cycle is None else cycle.setpoint_n,
        opening_mm=None if cycle is None else 1e3 * cycle.state.aperture_m,
        temperature_c=None if cycle is None else cycle.state.temperature_c,
        counts=None if frame is None else frame.counts,
        frame_age_s=age_s(latest.frame),
    )


class Hand(Protocol):
    """Gripper and tactile sensor; one thread commands them.

    Commands raise the errors of `gripper.gripper.Gripper` and
    `tactile.sensor.sensor.TactileSensor`, and `cell.errors.HandLost` if the process is lost.
    """

    @property
    def layout(self) -> TaxelLayout:
        """The taxels."""

    @property
    def period_s(self) -> float:
        """Period of the loop in s."""

    @property
    def own_process(self) -> bool:
        """Whether the loop has its own process, so that work in this process does not delay it."""

    @property
    def phase(self) -> GripperPhase:
        """Phase of the gripper, as of the last message."""

    @property
    def notes(self) -> tuple[str, ...]:
        """Messages for the operator about the loop; empty if all is normal."""

    @property
    def missing(self) -> tuple[str, ...]:
        """Why each line could not be opened that is missing since the hand was made."""

    @property
    def statistics(self) -> HandStatistics:
        """Counters of loop and links; the last ones if the hand is lost."""

    @property
    def latest(self) -> LatestValues:
        """Newest values of motions and `tick`, from any thread."""

    def start(self) -> VerificationReport:
        """Verify the servos; nothing moves. See `Gripper.start`."""

    def start_sensor(self) -> SourceIdentity:
        """Start the tactile sensor, which sends forces to the loop."""

    def stop_sensor(self) -> None:
        """Stop the tactile sensor."""

    def open(self, watch: OnPeriod) -> None:
        """Open the empty fingers."""

    def tare(self, n_frames: int) -> TareResult:
        """Take the zero of the taxels from ``n_frames`` frames, and return it."""

    @property
    def largest_ramp_n(self) -> float:
        """Largest force in N of a ramp, by what is known of the servos; no device is asked."""

    def check_ramp(self, ramp: ForceRamp) -> None:
        """Raise LimitExceeded for a ramp that `grasp` would refuse; uses no device."""

    def grasp(self, ramp: ForceRamp, watch: OnPeriod) -> GraspOutcome:
        """Close until both pads touch, follow the ramp; return while holding."""

    def press_pads_together(self, ramp: ForceRamp, watch: OnPeriod) -> GraspOutcome:
        """Close the empty fingers onto each other, follow the ramp; return while they press."""

    def measure_load(self, watch: OnPeriod) -> tuple[TimeSpan, ...]:
        """Measure the servos' currents under load while the empty pads press on each other.

        Returns when each finger moved alone.
        """

    def measure_friction(self, watch: OnPeriod) -> None:
        """Measure the servos' friction at several speeds; nothing may be between the fingers."""

    def read_drives(self) -> DriveReport:
        """Return the characteristics of the servos' drives, and notes about unusual values."""

    def use_drives(self, drives: Mapping[int, DriveCharacteristic]) -> None:
        """Use saved drive characteristics, by the servos' IDs."""

    def hold_at(self, force_n: float, duration_s: float, watch: OnPeriod) -> None:
        """Hold the part with another force for a time, and between later commands."""

    def squeeze(self, ramp: ForceRamp, watch: OnPeriod) -> GraspOutcome:
        """Follow a further ramp in the same grip, up from the held force; return while holding."""

    def end_ramp(self) -> None:
        """Let the ramp of the running grasp end where it is; see `Gripper.end_ramp`.

        Call it in the watch of a grasp, in the thread that commands the hand. A call that comes too
        late changes nothing, neither this grasp nor the next.
        """

    def release(self, watch: OnPeriod | None = None) -> ReleaseReport:
        """Let go, also without a start: the only command that lets a part go."""

    def conditions(self) -> tuple[ServoCondition, ...]:
        """Read torque and errors of each servo, also after the failure of another servo."""

    def inspect(self) -> VerificationReport:
        """Compare the servos with the settings; reads only."""

    def read_sensor(self, timeout_s: float) -> TactileReading:
        """Wait for a new reading of the taxels."""

    def tick(self) -> None:
        """Serve both links once a period between commands; raise their faults.

        While a part is carried this is a period of the force loop. A loop in its own process ticks
        by itself; this then raises its faults.
        """

    def keep_grip(self) -> None:
        """Freeze in any state; see `Gripper.keep_grip`."""

    def clear_fault(self, *, reboot: bool) -> None:
        """Acknowledge a fault of the servos; start a new process after a loss."""

    def request_stop(self) -> None:
        """Stop the running command with GraspStopped; safe from any thread and in signals."""

    def shutdown(self) -> str:
        """Leave servos and sensor in a defined state, as `Gripper.close` does.

        Returns the faults since the last command as text, for the record; empty without any.
        """

    def close(self) -> None:
        """Close the ports and the process of the loop; a held part stays held."""
