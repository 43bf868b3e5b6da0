"""The configuration of a cell: one frozen, checked value.

Lengths are in mm and angles in degrees here, because operators write this file; everything behind
it is SI. Each field states unit, range and meaning in its description, which the JSON schema shows.
An invalid `CellConfig` cannot exist.
"""

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from cell.config_grip import (
    ContactConfig,
    ImbalanceConfig,
    OverForceConfig,
    ServoCareConfig,
    SettleConfig,
    SlipConfig,
)
from cell.config_section import Section as _Section

SIMULATED = "simulated"
"""Port or interface name that wires in the simulated cell; nothing else ever does."""


Range = tuple[float, float]


def _check_range(name: str, value: Range, low: float, high: float) -> None:
    if not low <= value[0] <= value[1] <= high:
        raise ValueError(
            f"{name} is [{value[0]:g}, {value[1]:g}]; write [low, high] "
            f"with {low:g} <= low <= high <= {high:g}"
        )


class ServoConfig(_Section):
    """One Dynamixel servo of the gripper."""

    id: int = Field(ge=0, le=252)
    """ID on the bus, 0 to 252."""
    model: Literal["XM430-W350", "XM430-W210", "XL330-M288", "XC330-M288"] = "XM430-W350"
    """Model; it must be able to control current (an XL430 cannot and is refused)."""
    direction: Literal[1, -1] = 1
    """1 if growing position opens the finger, -1 if it closes it."""
    zero_pulse: int = Field(default=2048, ge=0, le=4095)
    """Present Position at angle 0 of the linkage, in pulses of 360/4096 degrees, 0 to 4095."""


class ParallelLinkageConfig(_Section):
    """Fingers on parallelograms: half opening = link_mm * sin(angle) + offset_mm."""

    kind: Literal["parallel_linkage"] = "parallel_linkage"
    """Kind of drive."""
    link_mm: float = Field(default=60.0, gt=5.0, le=500.0)
    """Length of the parallelogram's links in mm, 5 to 500."""
    offset_mm: float = Field(default=0.0, ge=-200.0, le=200.0)
    """Half opening at angle 0 in mm, -200 to 200."""


class RackPinionConfig(_Section):
    """Fingers on racks: half opening = pinion_radius_mm * angle + offset_mm."""

    kind: Literal["rack_pinion"]
    """Kind of drive."""
    pinion_radius_mm: float = Field(gt=2.0, le=100.0)
    """Pitch radius of the pinion in mm, 2 to 100."""
    offset_mm: float = Field(default=0.0, ge=-200.0, le=200.0)
    """Half opening at angle 0 in mm, -200 to 200."""


class GripperConfig(_Section):
    """Servos, linkage and limits of the gripper."""

    port: str = Field(default=SIMULATED, min_length=1)
    """Serial port of the servos, as /dev/ttyUSB0; `simulated` is the built-in simulated gripper."""
    baud_rate: Literal[57600, 115200, 1000000, 2000000, 3000000, 4000000] = 1000000
    """Baud rate of the servo bus in bit/s; 1000000 serves 200 Hz, 57600 does not."""
    servos: tuple[ServoConfig, ...] = Field(
        default=(ServoConfig(id=1), ServoConfig(id=2)), min_length=1, max_length=2
    )
    """One servo that drives both fingers, or two that drive a finger each."""
    linkage: Annotated[ParallelLinkageConfig | RackPinionConfig, Field(discriminator="kind")] = (
        ParallelLinkageConfig()
    )
    """How servo angle becomes opening."""
    loop_rate_hz: float = Field(default=200.0, ge=20.0, le=500.0)
    """Rate of the force loop in Hz, 20 to 500."""
    aperture_open_mm: float = Field(default=18.0, gt=0.0, le=400.0)
    """Opening between the pads before a grasp in mm, up to 400; a little more than the object."""
    aperture_min_mm: float = Field(default=0.5, ge=0.0, le=400.0)
    """Smallest opening that the fingers are closed to in mm; below it there is no object."""
    approach_speed_mm_s: float = Field(default=12.0, gt=0.0, le=200.0)
    """Closing speed until contact in mm/s of opening, up to 200; the impact grows with it."""
    open_speed_mm_s: float = Field(default=60.0, gt=0.0, le=200.0)
    """Opening speed in mm/s of opening, up to 200."""
    contact_force_n: float = Field(default=0.6, gt=0.0, le=5.0)
    """Force on both pads that counts as contact in N, up to 5; well above the sensor's noise."""
    contact_timeout_s: float = Field(default=5.0, gt=0.0, le=60.0)
    """Longest time to look for contact in s, up to 60."""
    force_max_n: float = Field(default=15.0, gt=0.0, le=50.0)
    """Cap of the grip force in N; 50 is the hard limit here. Set it per risk assessment."""
    current_max_a: float = Field(default=0.8, gt=0.0, le=2.3)
    """Cap of the goal current of each servo in A, up to 2.3."""
    temperature_max_c: float = Field(default=70.0, ge=30.0, le=80.0)
    """Servo temperature above which no ramp is started and a running one held, C, 30 to 80."""
    force_stale_ms: float = Field(default=100.0, ge=10.0, le=1000.0)
    """Oldest tactile force that control may use in ms, 10 to 1000."""
    bus_loss_ms: float = Field(default=70.0, ge=20.0, le=2000.0)
    """Time without answers of the servos after which their bus is given up in ms, 20 to 2000."""
    stall_max_ms: float = Field(default=250.0, ge=10.0, le=5000.0)
    """Lateness of one period after which the loop counts as stalled in ms, 10 to 5000."""
    watchdog_ms: float = Field(default=100.0, ge=20.0, le=2540.0)
    """Bus watchdog of the servos in ms, 20 to 2540 in steps of 20; armed while torque is on."""
    watchdog_self_test: bool = False
    """Whether the first opening proves for each servo that its watchdog stops the motor."""
    contact: ContactConfig = ContactConfig()
    """Approach and contact."""
    settle: SettleConfig = SettleConfig()
    """When a ramp's force counts as reached."""
    slip: SlipConfig = SlipConfig()
    """When a held part slips or is lost."""
    imbalance: ImbalanceConfig = ImbalanceConfig()
    """How different the fingers' forces may be."""
    over_force: OverForceConfig = OverForceConfig()
    """What is done with too much force."""
    servo_care: ServoCareConfig = ServoCareConfig()
    """Heat of the servos, and what a start may rewrite."""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        ids = [servo.id for servo in self.servos]
        if len(set(ids)) != len(ids):
            raise ValueError(f"servo ids {ids} repeat; give each servo its own id")
        if self.aperture_min_mm >= self.aperture_open_mm:
            raise ValueError(
                f"aperture_min_mm {self.aperture_min_mm:g} must be below "
                f"aperture_open_mm {self.aperture_open_mm:g}"
            )
        if self.contact_force_n >= self.force_max_n:
            raise ValueError(
                f"contact_force_n {self.contact_force_n:g} must be below "
                f"force_max_n {self.force_max_n:g}"
            )
        return self


class PadConfig(_Section):
    """One pad of taxels on a finger."""

    finger: Literal[0, 1]
    """Finger that carries the pad."""
    face: Literal["inner", "outer", "side_a", "side_b", "tip"]
    """Face of the finger; the two inner pads grip."""
    rows: int = Field(ge=1, le=64)
    """Taxels along the finger, 1 to 64."""
    columns: int = Field(ge=1, le=64)
    """Taxels across the finger, 1 to 64."""
    pitch_x_mm: float = Field(gt=0.1, le=50.0)
    """Distance between rows in mm, 0.1 to 50."""
    pitch_y_mm: float = Field(gt=0.1, le=50.0)
    """Distance between columns in mm, 0.1 to 50."""


class PadsConfig(_Section):
    """A layout of one's own."""

    name: str = Field(min_length=1, max_length=40)
    """Name of the layout."""
    pads: tuple[PadConfig, ...] = Field(min_length=2, max_length=32)
    """Pads in the order in which the control unit sends them."""
    adc_max: int = Field(ge=1, le=65535)
    """Full scale of the counts, 1 to 65535; above 255 samples are sent as 16 bit."""


class PaperCalibrationConfig(_Section):
    """Resistive foam after equation (11): R = 1.579 exp(-0.449 F) MOhm."""

    kind: Literal["paper"] = "paper"
    """Law from counts to force."""
    gain: float = Field(default=1.0, ge=0.1, le=10.0)
    """Factor on the force of each taxel, 0.1 to 10; found with a gauge object."""


class LinearCalibrationConfig(_Section):
    """Force proportional to counts."""

    kind: Literal["linear"]
    """Law from counts to force."""
    force_per_count_n: float = Field(gt=0.0, le=1.0)
    """Force of one count on one taxel in N, up to 1."""


BoardSerial = Annotated[int, Field(ge=0, le=4294967295)]


class TactileConfig(_Section):
    """The tactile control unit and its CAN bus."""

    interface: str = Field(default=SIMULATED, min_length=1)
    """python-can interface (socketcan, slcan, pcan, ...); `simulated` is the built-in one."""
    channel: str = Field(default="", max_length=200)
    """Channel of the interface, as can0 or /dev/ttyACM0; empty for `simulated`."""
    bitrate: Literal[125000, 250000, 500000, 800000, 1000000] = 1000000
    """Bit rate of the CAN bus in bit/s."""
    node_id: int = Field(default=5, ge=1, le=127)
    """CANopen node id of the control unit, 1 to 127."""
    serial_number: int | None = Field(default=None, ge=0, le=4294967295)
    """Serial number (object 1018h:4) that the unit must have; none: any."""
    layout: Literal["paper", "pinch"] | PadsConfig = "paper"
    """paper: 408 taxels, ten pads; pinch: two pads of 13 x 6, 12 bit; or pads of one's own."""
    calibration: Annotated[
        PaperCalibrationConfig | LinearCalibrationConfig, Field(discriminator="kind")
    ] = PaperCalibrationConfig()
    """From counts to force."""
    sync_period_ms: float = Field(default=20.0, ge=8.0, le=1000.0)
    """Time between two tactile frames in ms, 8 to 1000."""
    heartbeat_ms: int = Field(default=100, ge=10, le=5000)
    """Heartbeat period of the control unit in ms, 10 to 5000."""
    startup_timeout_s: float = Field(default=3.0, gt=0.0, le=60.0)
    """Longest time to wait for the control unit at the start in s, up to 60."""
    tare_frames: int = Field(default=100, ge=8, le=1000)
    """Frames averaged for the zero of each taxel, 8 to 1000; nothing may touch the pads."""
    board_serial_numbers: tuple[BoardSerial, BoardSerial] | None = None
    """Serial numbers (object 2103h) of the pads' boards on finger 0 and 1; none: any. With them
    pads that were exchanged are refused at the start."""
    loss_max_share: float = Field(default=0.05, ge=0.0, le=0.5)
    """Share of the last 50 frames that may be lost before the grip is held, 0 to 0.5."""
    foreign_max_hz: float = Field(default=2000.0, ge=0.0, le=100000.0)
    """Messages of other nodes that may come every second; more are taken for a flood."""
    bad_taxels_max_share: float = Field(default=0.05, ge=0.0, le=0.5)
    """Share of a pad's taxels that may be dead or stuck; they are masked, 0 to 0.5."""
    drift_max_share: float = Field(default=0.01, gt=0.0, le=0.2)
    """Share of the full scale by which a pad's zero may drift before a new one is needed."""


class LinearRampConfig(_Section):
    """Force grows evenly to its end, then is held."""

    kind: Literal["linear"] = "linear"
    """Shape of the force ramp."""
    rate_n_s: float = Field(default=5.0, gt=0.0, le=50.0)
    """Growth of the force in N/s, up to 50."""
    hold_s: float = Field(default=0.3, ge=0.0, le=60.0)
    """Time at the final force in s, up to 60."""


class StaircaseRampConfig(_Section):
    """Force grows in equal steps, each held."""

    kind: Literal["staircase"]
    """Shape of the force ramp."""
    n_levels: int = Field(default=4, ge=1, le=20)
    """Number of equal steps up to the final force, 1 to 20."""
    rate_n_s: float = Field(default=10.0, gt=0.0, le=50.0)
    """Growth of the force between the levels in N/s, up to 50."""
    hold_s: float = Field(default=0.2, ge=0.0, le=60.0)
    """Time at each level in s, up to 60."""


class SCurveRampConfig(_Section):
    """Force grows with a smooth start and end, then is held."""

    kind: Literal["s_curve"]
    """Shape of the force ramp."""
    duration_s: float = Field(default=1.0, gt=0.05, le=60.0)
    """Time from contact to the final force in s, 0.05 to 60."""
    hold_s: float = Field(default=0.3, ge=0.0, le=60.0)
    """Time at the final force in s, up to 60."""


class ListedPoseConfig(_Section):
    """One grasp of a listed sequence."""

    x_mm: float = Field(default=0.0, ge=-100.0, le=100.0)
    """Offset along the fingers in mm, -100 to 100."""
    y_mm: float = Field(default=0.0, ge=-100.0, le=100.0)
    """Offset across the fingers in mm, -100 to 100."""
    rotation_deg: float = Field(default=0.0, ge=-360.0, le=360.0)
    """Turn about the approach axis in degrees, -360 to 360."""
    roll_deg: float = Field(default=0.0, ge=-360.0, le=360.0)
    """Turn about the object's own axis in degrees, -360 to 360."""
    force_n: float = Field(default=4.0, gt=0.0, le=50.0)
    """Force at the end of the ramp in N, up to 50."""


class SequenceConfig(_Section):
    """Which poses and forces a sequence goes through, and when it stops."""

    kind: Literal["random", "grid", "list", "active"] = "random"
    """random: drawn from the ranges; grid: evenly spread over them; list: the listed poses;
    active: of several drawn ones that which is expected to tell most (teaching draws at random)."""
    x_mm: Range = (-2.0, 2.0)
    """Range of the offset along the fingers in mm, within -100 to 100."""
    y_mm: Range = (-2.0, 2.0)
    """Range of the offset across the fingers in mm, within -100 to 100."""
    rotation_deg: Range = (0.0, 360.0)
    """Range of the turn about the approach axis in degrees, within -360 to 360."""
    roll_deg: Range = (0.0, 360.0)
    """Range of the turn about the object's own axis in degrees, within -360 to 360."""
    force_n: Range = (2.0, 8.0)
    """Range of the force at the end of the ramp in N, within 0.5 to 50."""
    grid_points: int = Field(default=3, ge=1, le=20)
    """Values on each open axis of a grid, 1 to 20."""
    poses: tuple[ListedPoseConfig, ...] = Field(default=(), max_length=10000)
    """Poses of a list, in order."""
    candidates: int = Field(default=24, ge=2, le=1000)
    """Poses and forces that an active sequence weighs before each grasp, 2 to 1000."""
    ramp: Annotated[
        LinearRampConfig | StaircaseRampConfig | SCurveRampConfig, Field(discriminator="kind")
    ] = LinearRampConfig()
    """How the force grows."""
    max_grasps: int = Field(default=4, ge=1, le=100)
    """Most grasps of one identification, 1 to 100."""
    error_rate: float = Field(default=0.02, gt=0.0, lt=0.5)
    """Wanted rate of wrong answers at which a sequence stops early, 0 to 0.5."""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        _check_range("x_mm", self.x_mm, -100.0, 100.0)
        _check_range("y_mm", self.y_mm, -100.0, 100.0)
        _check_range("rotation_deg", self.rotation_deg, -360.0, 360.0)
        _check_range("roll_deg", self.roll_deg, -360.0, 360.0)
        _check_range("force_n", self.force_n, 0.5, 50.0)
        if self.kind == "list" and not self.poses:
            raise ValueError("a sequence of kind list needs at least one entry in poses")
        return self

    @property
    def largest_force_n(self) -> float:
        """The largest force that the sequence asks for in N."""
        if self.kind == "list":
            return max(pose.force_n for pose in self.poses)
        return self.force_n[1]


class PositionerConfig(_Section):
    """Who changes position and rotation between two grasps."""

    kind: Literal["simulated", "operator", "callback"] = "simulated"
    """simulated: the simulated cell; operator: a person at the terminal; callback: the host."""
    socket: str = Field(default="", max_length=200)
    """Socket of a simulated cell in another process (`positioner_socket` of `simulate`)."""


class RecognitionConfig(_Section):
    """How grasps become an answer."""

    recognizer: Literal["force_ramp", "shrinkage_lda", "level_check"] = "force_ramp"
    """Recogniser that is taught."""
    use_aperture: bool = True
    """Whether the opening between the fingers is used beside the taxels."""


class RecordingConfig(_Section):
    """Where recordings, data sets and reports go."""

    directory: str = Field(default="out", min_length=1, max_length=500)
    """Folder of recordings, data sets and reports; made when missing."""
    when_lost: Literal["finish", "hold"] = "finish"
    """When the disk refuses the recording: finish the grasps without it, or hold (a fault)."""


class LoopConfig(_Section):
    """How the force loop runs where the ports are real; what the system refuses is told loudly."""

    own_process: bool = True
    """Whether the loop has a process of its own, which recognition and files cannot hold up."""
    priority: int = Field(default=50, ge=0, le=99)
    """Real-time priority (SCHED_FIFO) of that process, 1 to 99; 0: scheduled as all others. The
    simulated cell of `simulate` takes one less."""
    lock_memory: bool = True
    """Whether the memory of that process is locked, so that paging cannot hold it up."""
    cpu: int | None = Field(default=None, ge=0, le=1023)
    """Processor that the process is bound to; none: any."""
    overruns_max: int = Field(default=10, ge=1, le=1000)
    """Periods in a row whose work took too long after which the grip is frozen, 1 to 1000."""


class SimulatedObjectConfig(_Section):
    """One object of the simulated cell."""

    label: str = Field(min_length=1, max_length=60)
    """Name of the object."""
    shape: str = Field(min_length=1, max_length=500)
    """Shape as text, as `cylinder:diameter=6mm,length=20mm` or `mesh:file=part.stl`."""


class SimulatorConfig(_Section):
    """The simulated cell; read only where a port is `simulated`, or by `simulate`."""

    objects: tuple[SimulatedObjectConfig, ...] = Field(
        default=(
            SimulatedObjectConfig(label="oval", shape="ellipsoid:length=14mm,diameter=11.7mm"),
            SimulatedObjectConfig(label="cylinder", shape="cylinder:diameter=6mm,length=20mm"),
            SimulatedObjectConfig(label="box", shape="box:length=15.9mm,width=10mm,height=10mm"),
            SimulatedObjectConfig(label="ball", shape="sphere:diameter=9.5mm"),
            SimulatedObjectConfig(label="dumbbell", shape="dumbbell:length=13mm,diameter=10mm"),
        ),
        min_length=1,
        max_length=1000,
    )
    """Objects that can be grasped; the default are the five of the paper."""
    noise: Literal["clipped_normal", "symmetric", "uniform", "none"] = "clipped_normal"
    """Noise of each taxel and frame; the paper's is a normal value clipped to 1 to 20 of 255."""
    noise_level: float = Field(default=1.0, ge=0.0, le=4.0)
    """Factor on the noise, 0 to 4; 1 is the paper's."""
    faults: tuple[Annotated[str, Field(min_length=1, max_length=200)], ...] = Field(
        default=(), max_length=100
    )
    """Faults to inject, as `can.loss=0.05@2s`; `tactile-cell simulate --list-faults` lists all."""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        labels = [entry.label for entry in self.objects]
        if len(set(labels)) != len(labels):
            raise ValueError(f"object labels {labels} repeat; give each object its own label")
        return self


class CellConfig(_Section):
    """Everything that a cell needs to know. Without a file: the simulated cell."""

    name: str = Field(default="simulated cell", min_length=1, max_length=80)
    """Name of the cell, for reports."""
    seed: int = Field(default=2008, ge=0, le=2**32 - 1)
    """Seed of everything random: poses, noise of the simulated cell."""
    host_timeout_s: float | None = Field(default=None, ge=0.05, le=3600.0)
    """Longest silence of the host program during a job in s, 0.05 to 3600; none: any."""
    gripper: GripperConfig = GripperConfig()
    """Servos, linkage and limits."""
    tactile: TactileConfig = TactileConfig()
    """Control unit and CAN bus."""
    sequence: SequenceConfig = SequenceConfig()
    """Poses, forces and stop rule."""
    positioner: PositionerConfig = PositionerConfig()
    """Who moves the object or the gripper."""
    recognition: RecognitionConfig = RecognitionConfig()
    """Recogniser and what it may use."""
    recording: RecordingConfig = RecordingConfig()
    """Where results go."""
    loop: LoopConfig = LoopConfig()
    """Process of the force loop."""
    simulator: SimulatorConfig = SimulatorConfig()
    """The simulated cell."""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.sequence.largest_force_n > self.gripper.force_max_n:
            raise ValueError(
                f"sequence asks for {self.sequence.largest_force_n:g} N, "
                f"gripper.force_max_n is {self.gripper.force_max_n:g} N; lower the one or raise "
                "the other after a risk assessment"
            )
        simulated = (self.gripper.port == SIMULATED, self.tactile.interface == SIMULATED)
        if simulated[0] != simulated[1]:
            raise ValueError(
                "gripper.port and tactile.interface must both be `simulated` or both be real: "
                "one simulated object cannot be touched by a real gripper"
            )
        if self.simulator.faults and not simulated[0]:
            raise ValueError(
                "simulator.faults are for the simulated cell, and this one has real ports: "
                "take them out"
            )
        if not simulated[0] and self.tactile.channel == "":
            raise ValueError("tactile.channel is empty; name the channel of the CAN interface")
        if (
            self.positioner.kind == "simulated"
            and not simulated[0]
            and self.positioner.socket == ""
        ):
            raise ValueError(
                "positioner.kind is simulated but the cell is not: choose operator or callback, "
                "or name the socket of a simulated cell in another process"
            )
        return self

    @property
    def simulated(self) -> bool:
        """Whether the built-in simulated cell is meant."""
        return self.gripper.port == SIMULATED
