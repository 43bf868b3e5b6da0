"""Captures of CAN traffic as pcap files, which Wireshark and tshark read."""

import struct
from pathlib import Path
from typing import Self

_MAGIC_NANOSECONDS = 0xA1B23C4D
"""First number of a pcap file whose stamps are in nanoseconds."""
_VERSION = (2, 4)
"""Version of the pcap format."""
_LINK_TYPE_CAN_SOCKETCAN = 227
"""LINKTYPE_CAN_SOCKETCAN of tcpdump.org's list."""
_SNAP_LENGTH = 65535
"""Longest packet in bytes that the file may hold."""
_EXTENDED_FLAG = 0x80000000
"""Bit of the identifier field that marks 29 bits."""
_GLOBAL_HEADER = struct.Struct("<LHHlLLL")
"""Magic, version, time zone, accuracy of the stamps, snap length, link type."""
_PACKET_HEADER = struct.Struct("<LLLL")
"""Seconds, nanoseconds, bytes in the file, bytes on the wire."""
_CAN_HEADER = struct.Struct(">LBBBB")
"""Identifier, length, CAN FD flags, two reserved bytes."""


class PcapWriter:
    """Writes CAN messages to a pcap file, link type 227, nanosecond stamps.

    Raises OSError if the file cannot be written.

    Parameters
    ----------
    path
        File to write; what it held is replaced.
    """

    def __init__(self, path: Path) -> None:
        self._file = path.open("wb")
        self._file.write(
            _GLOBAL_HEADER.pack(
                _MAGIC_NANOSECONDS, *_VERSION, 0, 0, _SNAP_LENGTH, _LINK_TYPE_CAN_SOCKETCAN
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

    def __exit__(self, *_error: object) -> None:
        self.close()
