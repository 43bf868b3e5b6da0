"""Base of tactile sensors: each kind is a plugin, whose section is `tactile.sensor`."""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

from pydantic import GetJsonSchemaHandler, ValidationError, ValidationInfo
from pydantic_core import CoreSchema

from cell.config.section import Section
from cell.errors import ConfigError, raised_as
from cell.plugins import SENSORS
from tactile.sensor.settings import SensorSettings

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
    """Lines and clock of a sensor."""

    clock: "Clock"
    """Monotonic clock: real, or that of a simulated cell."""
    open_serial: "Sequence[Callable[[], ByteStream]]" = ()
    """Functions that open the serial lines of `SensorConfig.serial_ports`, in their order. They
    raise OSError or gripper.errors.PortLost if a line cannot be opened; so does a lost line."""
    can_bus: "CanBus"
    """The open CAN bus; for a sensor without CAN, a bus that raises errors."""
    reopen_can: "Callable[[], CanBus] | None" = None
    """Reopens a lost bus."""


RestLimits = SensorSettings
"""Limits for pads without a load, and other settings of a sensor; the defaults are those of the
control unit."""


class SensorConfig(Section):
    """Base of the sections of `tactile.sensor`; each kind is a plugin.

    A kind has a field ``kind: Literal["its name"]``, and ``ports`` if it has serial lines.
    """

    kind: str
    """What reads the pads."""
    canopen: ClassVar[bool] = False
    """Whether it is a CANopen node after ``tactile/control_unit/control_unit.eds``."""
    on_can: ClassVar[bool] = False
    """Whether it is on the bus of `tactile.interface`, `channel` and `bitrate`."""
    lone_on_can: ClassVar[str] = ""
    """Reason why no CANopen node may be on its bus; empty: allowed."""
    layout: ClassVar[str | Mapping[str, Any]] = "paper"
    """Value of `tactile.layout` in its contract tests: a name, or a section."""
    baud_rate: ClassVar[int] = 115_200
    """Bit rate of its serial lines."""
    period_s: ClassVar[float] = 0.01
    """Usual time between two frames in s."""
    rest: ClassVar[RestLimits] = RestLimits()
    """Its pads without a load."""

    @classmethod
    def kinds(cls) -> list[type[Section]]:
        """Return the sections of the plugins that load."""
        return list(SENSORS.usable().values()) if cls is SensorConfig else [cls]

    @classmethod
    def __get_pydantic_json_schema__(
        cls, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        if cls is not SensorConfig:
            return handler(schema)
        return {"oneOf": [handler(kind.__pydantic_core_schema__) for kind in cls.kinds()]}

    @property
    def serial_ports(self) -> tuple[str, ...]:
        """Names of its serial ports: the key ``ports``, if the kind has it."""
        ports: tuple[str, ...] = getattr(self, "ports", ())
        return ports

    @property
    def fresh_zero_frames(self) -> int:
        """Number of frames for a zero before each approach; 0: the zero of the start is kept."""
        return 0

    def frame_period_s(self, _tactile: "TactileConfig") -> float:
        """Return the time between two frames in s."""
        return self.period_s

    def sends_forces(self, _tactile: "TactileConfig") -> bool:
        """Return whether force messages are used; else the force comes from the frames."""
        return False

    def check(self, tactile: "TactileConfig", layout: "TaxelLayout") -> None:
        """Raise ValueError or LayoutError if layout or lines do not fit the sensor."""

    def open_source(self, tactile: "TactileConfig", lines: SensorLines) -> "FrameSource":
        """Return its frame source, not started; see `TactileConfig.source_options`."""
        raise NotImplementedError

    def simulated(self) -> "SimulatedBoards | None":
        """Return its simulated devices; None for the control unit. Raises ConfigError without."""
        raise ConfigError(
            f"sensor {self.kind} cannot be simulated: set real ports in tactile.sensor"
        )


def sensor_section(value: Any, info: ValidationInfo) -> SensorConfig:
    """Return the section of a sensor from its values; ``kind`` names the plugin.

    Raises ValueError if there is no such sensor or a value is not valid.
    """
    if isinstance(value, SensorConfig):
        return value
    kind = value.get("kind") if isinstance(value, dict) else None
    if not isinstance(kind, str):
        raise ValueError(f"a section with kind, one of {', '.join(SENSORS)}")
    with raised_as(ValueError, ConfigError):
        section: type[SensorConfig] = SENSORS[kind]
    try:
        if info.mode == "json":
            return section.model_validate_json(json.dumps(value))
        return section.model_validate(value)
    except ValidationError as error:
        # As in a union of sections, a place has the kind in it.
        items: list[Any] = [
            {**item, "loc": (kind, *item["loc"])} for item in error.errors(include_url=False)
        ]
        raise ValidationError.from_exception_data(error.title, items) from None
