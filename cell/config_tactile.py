"""Config of the tactile sensor: pads, calibration, control unit, CAN bus."""

from typing import Annotated, Literal

from pydantic import Field

from cell.config_section import SIMULATED, Section


class PadConfig(Section):
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


class PadsConfig(Section):
    """A layout of one's own."""

    name: str = Field(min_length=1, max_length=40)
    """Name of the layout."""
    pads: tuple[PadConfig, ...] = Field(min_length=2, max_length=32)
    """Pads in the order in which the control unit sends them."""
    adc_max: int = Field(ge=1, le=65535)
    """Full scale of the counts, 1 to 65535; above 255 samples are sent as 16 bit."""


class PaperCalibrationConfig(Section):
    """Resistive foam after equation (11): R = 1.579 exp(-0.449 F) MOhm."""

    kind: Literal["paper"] = "paper"
    """Law from counts to force."""
    gain: float = Field(default=1.0, ge=0.1, le=10.0)
    """Factor on the force of each taxel, 0.1 to 10; found with a gauge object."""


class LinearCalibrationConfig(Section):
    """Force proportional to counts."""

    kind: Literal["linear"]
    """Law from counts to force."""
    force_per_count_n: float = Field(gt=0.0, le=1.0)
    """Force of one count on one taxel in N, up to 1."""


BoardSerial = Annotated[int, Field(ge=0, le=4294967295)]


class TactileConfig(Section):
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
