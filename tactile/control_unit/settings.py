"""Settings of the link to the control unit, and the load of its bus.

Each number is declared once, with its default and range; the config file uses both.
"""

from dataclasses import dataclass, field, fields
from math import inf
from typing import Any

from tactile.frames import MESSAGE_BYTES, FrameFormat
from tactile.layout import PadMount, TaxelLayout

WINDOW_SHARE = 0.85
"""Share of the period of SYNC for the burst of a frame: the synchronous window."""

_FORCE_TIMEOUT_SYNCS, _LEAST_FORCES = 2.0, 4.0
"""Allowed silence of force messages: periods of SYNC, and at least periods of these messages."""

_FORCE_LATE_S, _LATE_FORCES = 0.015, 3.0
"""Allowed delay of force messages in s, or in their periods if that is more."""


def setting(default: Any, low: float, high: float) -> Any:
    """Return a dataclass field with its default and range, both ends allowed."""
    return field(default=default, metadata={"low": low, "above": -inf, "high": high})


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkSettings:
    """Periods and limits of the link."""

    sync_period_s: float = setting(0.02, 0.001, 1.0)
    """Period of SYNC and of the frames in s."""
    heartbeat_s: float = setting(0.1, 0.005, 10.0)
    """Period of the unit's heartbeat in s."""
    startup_timeout_s: float = setting(3.0, 0.01, 120.0)
    """Longest time in s of the boot-up, and of the change to operational."""
    sdo_timeout_s: float = setting(0.3, 0.005, 10.0)
    """Longest wait for one SDO response in s."""
    max_loss_rate: float = setting(0.05, 0.0, 1.0)
    """Largest share of lost frames."""
    max_foreign_hz: float = setting(2000.0, 0.0, 1e5)
    """Allowed rate of messages of other nodes or unknown COB-IDs in 1/s."""
    serial: int | None = None
    """Serial number of the accepted unit; None accepts any."""
    boards: tuple[int, int] | None = None
    """Serial numbers of its pads' boards on finger 0 and finger 1; None accepts any."""
    force_period_s: float = setting(0.005, 0.0, 0.05)
    """Period of the force messages in s, a whole number of ms; 0: none, the force comes from
    frames. The default is that of a force loop at 200 Hz, which reads the newest one."""
    silence_s: float = setting(0.04, 0.02, 2.0)
    """Least silence in s of force messages or frames that is a fault. More than two periods of SYNC
    is for a simulated unit that shares the processors of the host."""
    mounts: tuple[PadMount, ...] = ()
    """Pads with another mounting than in the layout."""

    @property
    def force_timeout_s(self) -> float:
        """Time in s without a force message that is a fault: longer than one disturbed frame."""
        least_s = max(
            _FORCE_TIMEOUT_SYNCS * self.sync_period_s, _LEAST_FORCES * self.force_period_s
        )
        return max(self.silence_s, least_s)

    @property
    def force_late_s(self) -> float:
        """Allowed delay of force messages in s: with an older force the control loop oscillates."""
        return max(_FORCE_LATE_S, _LATE_FORCES * self.force_period_s)

    def __post_init__(self) -> None:
        for key in fields(self):
            value = getattr(self, key.name)
            if "low" in key.metadata and not key.metadata["low"] <= value <= key.metadata["high"]:
                raise ValueError(
                    f"{key.name} is {value}, must be {key.metadata['low']:g} to "
                    f"{key.metadata['high']:g}"
                )
        if abs(self.force_period_s - round(self.force_period_s, 3)) > 1e-9:
            raise ValueError(
                f"force_period_s is {self.force_period_s}, must be a whole number of ms"
            )


def message_bits(n_bytes: int) -> int:
    """Return the largest length in bits of a message with an identifier of 11 bits.

    ISO 11898-1: 47 bits in addition to the data, and one stuff bit for four bits that are stuffed.
    """
    return 47 + 8 * n_bytes + (33 + 8 * n_bytes) // 4


def _other_share(settings: LinkSettings, bitrate: int) -> float:
    """Return the load by force messages and heartbeats as a share of the bus."""
    bits_s = message_bits(1) / settings.heartbeat_s
    if settings.force_period_s:
        bits_s += message_bits(MESSAGE_BYTES) / settings.force_period_s
    return bits_s / bitrate


def _frame_bits(layout: TaxelLayout) -> int:
    return FrameFormat.of(layout).n_messages * message_bits(MESSAGE_BYTES)


def bus_load(layout: TaxelLayout, settings: LinkSettings, bitrate: int) -> float:
    """Return the largest load of a bus at ``bitrate`` bit/s as a share; above 1 is impossible."""
    period_bits = _frame_bits(layout) + message_bits(0)
    return period_bits / settings.sync_period_s / bitrate + _other_share(settings, bitrate)


def least_sync_period_s(layout: TaxelLayout, settings: LinkSettings, bitrate: int) -> float:
    """Return the least period of SYNC in s for a complete frame; inf if there is none.

    The burst of a frame must end in the synchronous window, and all other messages have priority.
    """
    left_bits_s = bitrate * (1.0 - _other_share(settings, bitrate))
    if left_bits_s <= 0.0:
        return inf
    return (_frame_bits(layout) / WINDOW_SHARE + message_bits(0)) / left_bits_s
