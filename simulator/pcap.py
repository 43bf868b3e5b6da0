"""Captures of CAN traffic in a form that Wireshark and tshark read."""

import struct
from pathlib import Path
from types import TracebackType
from typing import Self

_MAGIC_NANOSECONDS = 0xA1B23C4D
_LINK_TYPE_CAN_SOCKETCAN = 227
_SNAP_LENGTH = 65535
_EXTENDED_FLAG = 0x80000000
_GLOBAL_HEADER = struct.Struct("<LHHlLLL")
_PACKET_HEADER = struct.Struct("<LLLL")
_CAN_HEADER = struct.Struct(">LBBBB")


class PcapWriter:
    """Writes CAN messages to a pcap file, link type 227, nanosecond stamps.

    Parameters
    ----------
    path
        File to write; what it held is replaced.

    Raises
    ------
    OSError
        If the file cannot be written.
    """

    def __init__(self, path: Path) -> None:
        self._file = path.open("wb")
        self._file.write(
            _GLOBAL_HEADER.pack(
                _MAGIC_NANOSECONDS, 2, 4, 0, 0, _SNAP_LENGTH, _LINK_TYPE_CAN_SOCKETCAN
            )
        )

    def __call__(self, t_s: float, can_id: int, data: bytes, *, extended: bool = False) -> None:
        """Write one message that was through the wire at ``t_s`` s (a capture hook of a bus)."""
        flagged = can_id | (_EXTENDED_FLAG if extended else 0)
        packet = _CAN_HEADER.pack(flagged, len(data), 0, 0, 0) + data
        nanoseconds = round(t_s * 1e9)
        self._file.write(
            _PACKET_HEADER.pack(*divmod(nanoseconds, 1_000_000_000), len(packet), len(packet))
            + packet
        )

    def close(self) -> None:
        """Finish the file; a second call changes nothing."""
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc_value: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()
