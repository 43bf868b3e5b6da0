"""What each kind of tactile sensor says of itself: the section `tactile.sensor` is its plugin."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from cell.config.section import Section
from cell.errors import ConfigError

if TYPE_CHECKING:
    from cell.config.tactile import TactileConfig
    from gripper.clock import Clock
    from gripper.dynamixel.serial_port import ByteStream
    from simulator.boards.site import SimulatedBoards
    from tactile.can.bus import CanBus
    from tactile.layout import TaxelLayout
    from tactile.source import FrameSource


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorLines:
    """Lines and time of a sensor."""

    clock: "Clock"
    """Monotonic time: real, or that of a simulated cell."""
    open_serial: "Sequence[Callable[[], ByteStream]]" = ()
    """Open the serial lines of `SensorConfig.serial_ports`, in their order. They raise OSError or
    gripper.errors.PortLost where a line cannot be opened, and where it is gone later."""
    can_bus: "CanBus"
    """The open CAN bus; for a kind that is not on CAN, one that raises."""
    reopen_can: "Callable[[], CanBus] | None" = None
    """Opens a lost bus anew."""
    real_time: bool = True
    """Whether time passes by itself; else only while somebody waits."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RestLimits:
    """How pads look without a load; None: as those of the control unit."""

    rest_share: float | None = None
    """Share of the full scale at which a taxel may rest."""
    bump_share: float | None = None
    """Share of the full scale by which the mean of nine taxels may differ from that of its pad."""
    noise_share: float | None = None
    """Noise of a sample as a share of the full scale, below which it counts as none."""
    stuck_frames: int | None = None
    """Frames in which a healthy taxel may repeat itself."""


class SensorConfig(Section):
    """Base of the sections that `tactile.sensor` may have; each kind is a plugin.

    A kind has a field ``kind: Literal["its name"]``, and ``ports`` where it has serial lines.
    """

    kind: str
    """What reads the pads."""
    canopen: ClassVar[bool] = False
    """Whether it is a CANopen node after ``tactile/unit/control_unit.eds``."""
    on_can: ClassVar[bool] = False
    """Whether it is on the bus of `tactile.interface`, `channel` and `bitrate`."""
    lone_on_can: ClassVar[str] = ""
    """Why no CANopen node may be on its bus; empty where one may."""
    layout: ClassVar[str] = "paper"
    """Named layout that its defaults fit."""
    baud_rate: ClassVar[int] = 115_200
    """Bit rate of its serial lines."""
    period_s: ClassVar[float] = 0.01
    """Usual time between two frames in s."""
    rest: ClassVar[RestLimits] = RestLimits()
    """Its pads without a load."""

    @property
    def serial_ports(self) -> tuple[str, ...]:
        """Names of its serial ports: the key ``ports`` of a kind that has any."""
        ports: tuple[str, ...] = getattr(self, "ports", ())
        return ports

    @property
    def fresh_zero_frames(self) -> int:
        """Frames of a zero before each approach; 0: the zero of the start is kept."""
        return 0

    def frame_period_s(self, _tactile: "TactileConfig") -> float:
        """Return the time between two frames in s."""
        return self.period_s

    def sends_forces(self, _tactile: "TactileConfig") -> bool:
        """Return whether force messages are asked for; else the force comes from the frames."""
        return False

    def check(self, tactile: "TactileConfig", layout: "TaxelLayout") -> None:
        """Raise ValueError or LayoutError for a layout or lines that it cannot have."""

    def open_source(self, tactile: "TactileConfig", lines: SensorLines) -> "FrameSource":
        """Return its frame source, not started; `TactileConfig.source_options` are for most."""
        raise NotImplementedError

    def simulated(self) -> "SimulatedBoards | None":
        """Return its simulated devices; None for the control unit. Raises ConfigError without."""
        raise ConfigError(f"sensor {self.kind} has no simulated device: name real ports")
