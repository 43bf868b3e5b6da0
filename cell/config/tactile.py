"""Config of the tactile sensor: pads, calibration, control unit or boards, and their lines."""

from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import BeforeValidator, Discriminator, Field, SerializeAsAny, Tag, model_validator

from cell.config.section import MILLI, SIMULATED, Section, declared_values, setting_of
from cell.config.sensor import SensorConfig, sensor_section
from cell.errors import ConfigError, raised_as
from cell.plugins import SENSORS
from tactile.control_unit.settings import LinkSettings
from tactile.errors import CalibrationError, LayoutError
from tactile.layout import LAYOUTS, Face, Pad, PadMount, TaxelLayout, taxel_order
from tactile.sensor.calibration import Calibration, FoamCalibration, TableCalibration

FASTEST_BITRATE = 1_000_000
"""Largest bit rate of a CAN bus in bit/s."""
LONGEST_SYNC_MS = 50.0
"""Longest time in ms between two frames for control of a grip."""


class PadConfig(Section):
    """One pad of taxels on a finger."""

    finger: Literal[0, 1]
    """Finger that carries the pad."""
    face: Face
    """Face of the finger; the two inner pads grip."""
    rows: int = Field(ge=1, le=64)
    """Taxels along the finger, 1 to 64."""
    columns: int = Field(ge=1, le=64)
    """Taxels across the finger, 1 to 64."""
    pitch_x_mm: float = Field(gt=0.1, le=50.0)
    """Distance between rows in mm, 0.1 to 50."""
    pitch_y_mm: float = Field(gt=0.1, le=50.0)
    """Distance between columns in mm, 0.1 to 50."""


class PadsConfig(Section):
    """A layout of your own."""

    name: str = Field(min_length=1, max_length=40)
    """Name of the layout."""
    pads: tuple[PadConfig, ...] = Field(min_length=2, max_length=32)
    """Pads in the order of the control unit's samples."""
    adc_max: int = Field(ge=1, le=65535)
    """Full scale of the counts, 1 to 65535; above 255 samples have 16 bits."""


class CalibrationConfig(Section):
    """Law from counts to force: a table, or the paper's equation (11).

    That is R = 1.579 exp(-0.449 F) in MOhm and N. A table is linear between its entries and beyond
    them; `commission` measures it with weights.
    """

    counts: tuple[Annotated[float, Field(gt=0.0, le=65535.0)], ...] = Field(
        default=(), max_length=64
    )
    """Tared counts of one taxel, rising, of a table; without any the law is equation (11)."""
    force_n: tuple[Annotated[float, Field(gt=0.0, le=100.0)], ...] = ()
    """Force on one taxel in N at each of them, rising; one entry is a straight line."""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if len(self.counts) != len(self.force_n):
            raise ValueError(
                f"there are {len(self.counts)} counts and {len(self.force_n)} values of force_n; "
                "write as many of each"
            )
        if self.counts:
            with raised_as(ValueError, CalibrationError):
                TableCalibration(self.counts, self.force_n, 1)
        return self


class PadMountConfig(Section):
    """A pad that is mounted differently from the layout."""

    pad: int = Field(ge=0, le=31)
    """Number of the pad in the layout, from 0."""
    sent_as: int = Field(ge=0, le=31)
    """Position of its samples in the control unit's order, as a number of a pad."""
    rows_mirrored: bool = False
    """Whether the unit sends the last row first."""
    columns_mirrored: bool = False
    """Whether the unit sends the last column of each row first; with rows_mirrored the pad is
    turned by 180 degrees."""


LayoutName = Literal[
    "flexitac_12x32", "flexitac_16x16", "flexitac_16x32", "paper", "pinch", "uskin_4x4"
]
"""Names of `tactile.layout.LAYOUTS`."""
BoardSerial = Annotated[int, Field(ge=0, le=4294967295)]
PadGain = Annotated[float, Field(ge=0.2, le=5.0)]


def _control_unit() -> SensorConfig:
    """Return the default sensor, loaded only where it is used."""
    unit: SensorConfig = SENSORS["control_unit"]()
    return unit


class TactileConfig(Section):
    """The tactile sensor: the control unit and its CAN bus, or other boards."""

    sensor: Annotated[SerializeAsAny[SensorConfig], BeforeValidator(sensor_section)] = Field(
        default_factory=_control_unit
    )
    """Sensor that reads the pads: the control unit, or boards with their own lines."""
    interface: str = Field(default=SIMULATED, min_length=1)
    """python-can interface (socketcan, slcan, pcan, ...); `simulated`: the built-in interface."""
    channel: str = Field(default="", max_length=200, strict=False, coerce_numbers_to_str=True)
    """Channel of the interface, for example can0, /dev/ttyACM0 or the number 0; empty for
    `simulated`."""
    bitrate: Literal[125000, 250000, 500000, 800000, 1000000] = 1000000
    """Bit rate of the CAN bus in bit/s."""
    node_id: int = Field(default=5, ge=1, le=127)
    """CANopen node id of the control unit, 1 to 127."""
    serial_number: int | None = Field(default=None, ge=0, le=4294967295)
    """Required serial number of the unit (object 1018h:4); none: any."""
    layout: Annotated[
        Annotated[LayoutName, Tag("name")] | Annotated[PadsConfig, Tag("pads")],
        Discriminator(lambda value: "name" if isinstance(value, str) else "pads"),
    ] = "paper"
    """paper: 408 taxels, ten pads; pinch: two pads of 13 x 6, 12 bit; flexitac_12x32,
    flexitac_16x32 and flexitac_16x16: two pads of 2 mm pitch, rows along the finger; uskin_4x4: two
    pads of 4.7 mm pitch; or a section with pads of your own."""
    mounting: tuple[PadMountConfig, ...] = Field(default=(), max_length=32)
    """Pads that are mounted differently from the layout: exchanged, turned or mirrored."""
    calibration: CalibrationConfig = CalibrationConfig()
    """Law from counts to force."""
    pad_gains: tuple[PadGain, PadGain] = (1.0, 1.0)
    """Factors on the force of that law for the pads of finger 0 and 1, 0.2 to 5."""
    sync_period_ms: float = setting_of(
        LinkSettings, "sync_period_s", MILLI, at_least=8.0, at_most=LONGEST_SYNC_MS
    )
    """Time between two tactile frames in ms, 8 to 50."""
    force_period_ms: int = setting_of(LinkSettings, "force_period_s", MILLI, number=int)
    """Time between two force messages in ms, 0 to 50: one period of the force loop; less gives a
    softer first touch, but more bus load. 0: no messages, the force comes from the frames."""
    silence_ms: float = setting_of(LinkSettings, "silence_s", MILLI, at_most=1000.0)
    """Silence of force messages or frames in ms after which the grip is held, 20 to 1000; at least
    two periods of SYNC (force messages) or three (frames) are used, at most 15 force messages."""
    heartbeat_ms: int = setting_of(
        LinkSettings, "heartbeat_s", MILLI, at_least=10, at_most=1000, number=int
    )
    """Heartbeat period of the control unit in ms, 10 to 1000."""
    startup_timeout_s: float = setting_of(
        LinkSettings, "startup_timeout_s", at_least=0.5, at_most=60.0
    )
    """Longest time to wait for the control unit at the start in s, 0.5 to 60; at least twice
    heartbeat_ms."""
    tare_frames: int = Field(default=100, ge=8, le=500)
    """Frames averaged for the zero of each taxel, 8 to 500; nothing may touch the pads."""
    board_serial_numbers: tuple[BoardSerial, BoardSerial] | None = None
    """Serial numbers (object 2103h) of the pads' boards on finger 0 and 1; none: any. With numbers
    a start refuses exchanged pads."""
    loss_max_share: float = setting_of(LinkSettings, "max_loss_rate", at_most=0.5)
    """Share of the newest frames that may be lost before the grip is held, 0 to 0.5."""
    foreign_max_hz: float = setting_of(LinkSettings, "max_foreign_hz")
    """Allowed messages of other nodes per second; more count as a flood."""
    bad_taxels_max_share: float = Field(default=0.05, ge=0.0, le=0.5)
    """Allowed share of dead or stuck taxels of a pad, 0 to 0.5; these taxels are masked."""
    drift_max_share: float = Field(default=0.01, gt=0.0, le=0.2)
    """Allowed drift of a pad's zero as a share of the full scale, up to 0.2; beyond it a new zero
    is needed."""

    @property
    def simulated(self) -> bool:
        """Whether the pads are those of the simulated cell."""
        lines = self.serial_ports or ((self.interface,) if self.sensor.on_can else ())
        return SIMULATED in lines

    @property
    def serial_ports(self) -> tuple[str, ...]:
        """Serial ports of the sensor; empty for a sensor on CAN."""
        return self.sensor.serial_ports

    @property
    def place(self) -> str:
        """Ports, or interface and channel, for messages."""
        if not self.sensor.on_can:
            return ", ".join(self.serial_ports) or self.sensor.kind
        return f"{self.interface} {self.channel}".strip()

    @property
    def frame_period_s(self) -> float:
        """Time between two frames in s."""
        return self.sensor.frame_period_s(self)

    @property
    def sends_forces(self) -> bool:
        """Whether force messages are used; else the force comes from the frames."""
        return self.sensor.sends_forces(self)

    @property
    def source_options(self) -> dict[str, Any]:
        """Arguments of most frame sources: layout, mounts and limits, in SI."""
        return {
            "layout": layout_from_config(self),
            "mounts": pad_mounts(self),
            "silence_s": MILLI * self.silence_ms,
            "max_loss_rate": self.loss_max_share,
            "startup_timeout_s": self.startup_timeout_s,
        }

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        ports = self.serial_ports
        if SIMULATED in ports and {*ports} != {SIMULATED}:
            raise ValueError(f"sensor.ports are {ports}: write {SIMULATED!r} for each or for none")
        least_s = 2.0 * MILLI * self.heartbeat_ms
        if self.startup_timeout_s < least_s:
            raise ValueError(
                f"startup_timeout_s is {self.startup_timeout_s:g}, but with heartbeat_ms "
                f"{self.heartbeat_ms} the start of the control unit takes {least_s:g} s: raise "
                f"startup_timeout_s or lower heartbeat_ms"
            )
        if self.mounting:
            with raised_as(ValueError, ConfigError, LayoutError, where="mounting"):
                taxel_order(layout_from_config(self), pad_mounts(self))
        return self


def pad_mounts(config: TactileConfig) -> tuple[PadMount, ...]:
    """Return the pads that are mounted differently from the layout."""
    return tuple(PadMount(**mount.model_dump()) for mount in config.mounting)


def link_settings(config: TactileConfig) -> LinkSettings:
    """Return the settings of the link to the control unit in SI."""
    return LinkSettings(
        serial=config.serial_number,
        boards=config.board_serial_numbers,
        mounts=pad_mounts(config),
        **declared_values(config, LinkSettings),
    )


def layout_from_config(config: TactileConfig) -> TaxelLayout:
    """Return the layout of a config, named or custom.

    Raises ConfigError if custom pads are no valid layout (one inner pad for each finger).
    """
    if isinstance(config.layout, str):
        return LAYOUTS[config.layout]()
    own, shape = config.layout, {"finger", "face", "rows", "columns"}
    pads = [
        Pad(
            name=f"finger{pad.finger}.{pad.face}.{number}",
            pitch_x_m=pad.pitch_x_mm * 1e-3,
            pitch_y_m=pad.pitch_y_mm * 1e-3,
            **pad.model_dump(include=shape),
        )
        for number, pad in enumerate(own.pads)
    ]
    with raised_as(ConfigError, LayoutError, where="tactile.layout"):
        return TaxelLayout(name=own.name, pads=tuple(pads), adc_max=own.adc_max)


def make_calibration(
    config: TactileConfig, layout: TaxelLayout, *, with_gains: bool = True
) -> Calibration:
    """Return the law from counts to force of a config for a layout, with the gains of its pads."""
    law, gains = config.calibration, np.array(config.pad_gains)
    gain: np.ndarray[Any, Any] | float = 1.0
    if with_gains and config.pad_gains != (1.0, 1.0):
        gain = gains[[pad.finger for pad in layout.pads]][layout.taxel_pad]
    if not law.counts:
        return FoamCalibration(layout.adc_max, gain)
    return TableCalibration(law.counts, law.force_n, layout.adc_max, gain)
