"""What a link to the control unit needs to be told, and what it tells."""

from dataclasses import dataclass, field

from tactile import eds
from tactile.assembler import FrameStatistics
from tactile.eds import TransmissionMode


@dataclass(frozen=True, slots=True, kw_only=True)
class NodeIdentity:
    """Identity object 0x1018 of the unit that answers, and its name."""

    vendor_id: int
    product_code: int
    revision: int
    serial: int
    name: str = ""
    boards: tuple[int, int] = (0, 0)
    """Serial numbers of the pads' boards on finger 0 and finger 1; 0 where a board has none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ExpectedIdentity:
    """Which unit is accepted; None accepts any.

    The revision's upper 16 bits (the behaviour on the bus, CiA 301) must match, the lower may not.
    """

    vendor_id: int | None = eds.VENDOR_ID
    product_code: int | None = eds.PRODUCT_CODE
    revision: int | None = eds.REVISION
    serial: int | None = None
    boards: tuple[int, int] | None = None
    """Serial numbers of the pads' boards on finger 0 and finger 1."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkSettings:
    """Periods and limits of the link.

    Attributes
    ----------
    sync_period_s
        Period of SYNC, and so of the frames, in s.
    sync_window_s
        The unit gives up a burst that takes longer than this, in s; at most the period. By
        default 85 % of the period.
    heartbeat_s
        Period of the unit's heartbeat in s.
    heartbeat_factor
        The heartbeat is lost after this many periods.
    startup_timeout_s
        The unit must have booted, and later be operational, within this time in s.
    sdo_timeout_s
        Longest wait for one SDO response in s.
    frame_timeout_periods
        So many SYNCs without a whole frame are a fault.
    max_loss_rate, loss_window_frames
        A larger share of frames lost among so many is a fault.
    late_periods
        Frames that come so many periods later than before, three times, are a fault.
    max_foreign_hz
        So many messages of other nodes or unknown COB-IDs may come every second.
    max_malformed_hz
        So many damaged or unusable messages may come every second.
    error_passive_s
        The host's CAN controller may be error-passive for this long, in s.
    identity
        Which unit is accepted.
    mode
        Samples, features, or both.
    threaded
        True: a thread receives (real buses). False: `poll` asks the bus (buses in memory).
    """

    sync_period_s: float = 0.02
    sync_window_s: float | None = None
    heartbeat_s: float = 0.1
    heartbeat_factor: float = 1.5
    startup_timeout_s: float = 3.0
    sdo_timeout_s: float = 0.3
    frame_timeout_periods: int = 3
    max_loss_rate: float = 0.05
    loss_window_frames: int = 50
    late_periods: int = 2
    max_foreign_hz: float = 2000.0
    max_malformed_hz: float = 20.0
    error_passive_s: float = 0.5
    identity: ExpectedIdentity = field(default_factory=ExpectedIdentity)
    mode: TransmissionMode = TransmissionMode.RAW
    threaded: bool = True

    def __post_init__(self) -> None:
        limits = (
            ("sync_period_s", self.sync_period_s, 0.001, 1.0),
            ("sync_window_s", self.window_s, 0.0005, self.sync_period_s),
            ("heartbeat_s", self.heartbeat_s, 0.005, 10.0),
            ("heartbeat_factor", self.heartbeat_factor, 1.0, 10.0),
            ("startup_timeout_s", self.startup_timeout_s, 0.01, 120.0),
            ("sdo_timeout_s", self.sdo_timeout_s, 0.005, 10.0),
            ("frame_timeout_periods", self.frame_timeout_periods, 1, 1000),
            ("max_loss_rate", self.max_loss_rate, 0.0, 1.0),
            ("loss_window_frames", self.loss_window_frames, 1, 10_000),
            ("late_periods", self.late_periods, 1, 1000),
            ("max_foreign_hz", self.max_foreign_hz, 0.0, 1e5),
            ("max_malformed_hz", self.max_malformed_hz, 0.0, 1e5),
            ("error_passive_s", self.error_passive_s, 0.0, 10.0),
        )
        for name, value, low, high in limits:
            if not low <= value <= high:
                raise ValueError(f"{name} is {value}, must be {low:g} to {high:g}")

    @property
    def window_s(self) -> float:
        """Synchronous window in s."""
        return 0.85 * self.sync_period_s if self.sync_window_s is None else self.sync_window_s


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkStatistics:
    """What the link counted since its start.

    Attributes
    ----------
    frames
        Frames and frame messages.
    recent_loss_rate
        Share of frames lost in the window of `LinkSettings.loss_window_frames`.
    syncs
        SYNC messages sent.
    late_syncs
        SYNCs that were due more than one period ago when `poll` came to send them: not made up for.
    foreign
        Messages of other nodes or of unknown COB-IDs.
    malformed
        Emergencies, features and remote or extended messages that cannot be used, and lines of a
        serial adapter that are none.
    error_frames
        Error frames of the host's CAN controller.
    """

    frames: FrameStatistics
    recent_loss_rate: float
    syncs: int
    late_syncs: int
    foreign: int
    malformed: int
    error_frames: int
