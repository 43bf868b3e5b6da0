"""The hand: gripper and tactile sensor as one, wherever their force loop runs.

`cell.hand.local.LocalHand` runs the loop in this process, in the caller's thread: virtual time and
tests. `cell.hand.client.HandProcess` runs it in a process of its own: real time.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

from gripper.dynamixel.drive import DriveCharacteristic, DriveReport
from gripper.dynamixel.transactions import BusStatistics
from gripper.force.ramp import ForceRamp
from gripper.force.timing import LoopStatistics
from gripper.values.force_sensor import ForceSample
from gripper.values.outcome import GraspOutcome, ReleaseReport
from gripper.values.servo_checks import ServoCondition, VerificationReport
from gripper.values.state import Cycle, GripperPhase
from tactile.layout import TaxelLayout
from tactile.sensor.sensor import SensorStatistics, TactileReading
from tactile.sensor.tare import TareResult
from tactile.source import SourceIdentity, SourceStatistics, TactileFrame

OnPeriod = Callable[[Cycle, Sequence[TactileFrame]], None]
"""Callback for each period of a command, in order, with the tactile frames that came in it.

What it raises stops the command with the grip kept, and passes on.
"""


FORCE_FROM_FRAMES = (
    "the force comes from whole frames and is slower: the control unit has no force messages "
    "(object 2140h), tactile.force_period_ms is 0, or the two inner pads are not mounted alike "
    "(tactile.mounting). A gripper.approach_speed_mm_s of 12 keeps the impact of the contact small"
)
"""Note on a control unit that sends no force messages."""


@dataclass(frozen=True, slots=True, kw_only=True)
class HandStatistics:
    """What loop and links counted."""

    loop: LoopStatistics
    """Timing of the force loop since it was made."""
    servo_bus: BusStatistics
    """Since the servos' port was opened."""
    source: SourceStatistics
    """Of the frames, since the last start of the tactile sensor."""
    sensor: SensorStatistics = field(default_factory=SensorStatistics)
    """Since the last start of the tactile sensor."""
    undelivered: int = 0
    """Periods that did not reach this process because it took nothing for too long."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LatestValues:
    """Newest values of a hand, of motions and of the supervision between them; None before any."""

    cycle: Cycle | None = None
    """Newest period in which the servos answered."""
    force: ForceSample | None = None
    """Newest valid force sample."""
    frame: TactileFrame | None = None
    """Newest tactile frame."""

    def then(
        self, cycle: Cycle | None, force: ForceSample | None, frames: Sequence[TactileFrame]
    ) -> "LatestValues":
        """Return the newest values after one more period, whose force may be none or not valid."""
        return LatestValues(
            cycle=cycle or self.cycle,
            force=force if force is not None and force.valid else self.force,
            frame=frames[-1] if frames else self.frame,
        )


class Hand(Protocol):
    """Gripper and tactile sensor; one thread commands them.

    Commands raise what `gripper.gripper.Gripper` and `tactile.sensor.sensor.TactileSensor` raise,
    and `cell.errors.HandLost` where the process of the loop is gone.
    """

    @property
    def layout(self) -> TaxelLayout:
        """The taxels."""

    @property
    def period_s(self) -> float:
        """Period of the loop in s."""

    @property
    def own_process(self) -> bool:
        """Whether the loop runs in a process of its own, so that no computing here delays it."""

    @property
    def phase(self) -> GripperPhase:
        """What the gripper is doing, as of the last message."""

    @property
    def notes(self) -> tuple[str, ...]:
        """Messages for the operator on how the loop runs; empty where all is as wanted."""

    @property
    def statistics(self) -> HandStatistics:
        """Counters of loop and links; of a hand that is gone the last ones that came."""

    @property
    def latest(self) -> LatestValues:
        """What motions and `tick` measured last, from any thread."""

    def start(self) -> VerificationReport:
        """Verify the servos; nothing moves. See `Gripper.start`."""

    def start_sensor(self) -> SourceIdentity:
        """Start the tactile sensor. From now on the loop gets forces."""

    def stop_sensor(self) -> None:
        """Stop the tactile sensor."""

    def open(self, watch: OnPeriod) -> None:
        """Open the empty fingers."""

    def tare(self, n_frames: int) -> TareResult:
        """Take the zero of the taxels from so many frames, and return it."""

    @property
    def largest_ramp_n(self) -> float:
        """Largest force in N of a ramp, by what is known of the servos; no device is asked."""
        ...

    def check_ramp(self, ramp: ForceRamp) -> None:
        """Raise LimitExceeded for a ramp that `grasp` would refuse; no device is asked."""

    def grasp(self, ramp: ForceRamp, watch: OnPeriod) -> GraspOutcome:
        """Close until both pads touch, follow the ramp; return while holding."""

    def press_pads_together(self, ramp: ForceRamp, watch: OnPeriod) -> GraspOutcome:
        """Close the empty fingers onto each other, follow the ramp; return while they press."""
        ...

    def measure_load(self, watch: OnPeriod) -> None:
        """Measure the servos' currents for their load, while the empty pads press on each other."""

    def measure_friction(self, watch: OnPeriod) -> None:
        """Measure the servos' friction at several speeds; nothing may be between the fingers."""

    def read_drives(self) -> DriveReport:
        """Return what is known of the servos' drives, and what was unusual since then."""
        ...

    def use_drives(self, drives: Mapping[int, DriveCharacteristic]) -> None:
        """Begin with drive characteristics that were kept, by the servos' IDs."""

    def hold_at(self, force_n: float, duration_s: float, watch: OnPeriod) -> None:
        """Hold the part with another force for a time, and control it on between commands."""

    def squeeze(self, ramp: ForceRamp, watch: OnPeriod) -> GraspOutcome:
        """Follow a further ramp in the same grip, up from the held force; return while holding."""

    def end_ramp(self) -> None:
        """Let the ramp of the running grasp end where it is; see `Gripper.end_ramp`.

        Safe from any thread, and meant for the watch of a grasp. One that comes too late changes
        nothing, neither this grasp nor the next.
        """

    def release(self, watch: OnPeriod | None = None) -> ReleaseReport:
        """Let go, without a start too: the only command that lets a part go."""

    def conditions(self) -> tuple[ServoCondition, ...]:
        """Read torque and errors of each servo, of those too that another one hides."""

    def inspect(self) -> VerificationReport:
        """Compare the servos with the settings; reads only."""

    def read_sensor(self, timeout_s: float) -> TactileReading:
        """Wait for a new reading of the taxels."""

    def tick(self) -> None:
        """Between commands, once a period: both links stay alive; what is wrong with them raises.

        While a part is carried this is a period of the force loop.

        A loop in a process of its own ticks by itself; this then raises what it found.
        """

    def keep_grip(self) -> None:
        """Freeze in any state; see `Gripper.keep_grip`."""

    def clear_fault(self, *, reboot: bool) -> None:
        """Acknowledge a fault of the servos; a process that is gone is started anew."""

    def request_stop(self) -> None:
        """Let the running command end with GraspStopped; safe from any thread and in signals."""

    def shutdown(self) -> str:
        """Leave servos and sensor in a defined state, as `Gripper.close` does.

        Returns what was found wrong since the last command, for the record: no command needs a
        sound hand any more. Empty where nothing was.
        """

    def close(self) -> None:
        """Give ports, and the process of the loop, back; a held part stays held."""
