"""The door of the control unit's SDO server: lets requests in that the server can answer.

canopen's server answers expedited and segmented transfers. It has no idea of a segment without a
transfer, of a transfer without an end or of block transfers, and fails on requests that are too
short. The gate refuses those with the abort codes of CiA 301, so that the server never sees them.
"""

import struct
from collections.abc import Callable
from enum import Enum

_ABORT = struct.Struct("<BHBL")
_INITIATE = struct.Struct("<BHB")
_ABORT_COMMAND = 0x80

UNKNOWN_COMMAND = 0x0504_0001
OUT_OF_MEMORY = 0x0504_0005
TOO_LONG = 0x0607_0012
TOO_SHORT = 0x0607_0013

MAX_DOWNLOAD_BYTES = 1024
"""A download of more than this is refused: no object of the unit is that long."""


class _Transfer(Enum):
    NONE = 0
    UPLOAD = 1
    DOWNLOAD = 2


class SdoGate:
    """Checks SDO requests and follows the transfer that is going on.

    Parameters
    ----------
    serve
        Hands a request to the server.
    respond
        Sends 8 bytes to the client.
    """

    __slots__ = ("_index", "_received", "_respond", "_serve", "_size", "_subindex", "_transfer")

    def __init__(
        self, serve: Callable[[bytearray], None], respond: Callable[[bytes], None]
    ) -> None:
        self._serve = serve
        self._respond = respond
        self.reset()

    def reset(self) -> None:
        """Forget the transfer that is going on."""
        self._transfer = _Transfer.NONE
        self._index, self._subindex = 0, 0
        self._received = 0
        self._size: int | None = None

    def request(self, data: bytes) -> None:
        """Answer one request; requests that are not 8 bytes long are no SDO and stay unheard."""
        if len(data) != 8:
            return
        command = data[0] >> 5
        if command == 0:
            self._download_segment(data)
        elif command == 1:
            self._initiate_download(data)
        elif command == 2:
            _, self._index, self._subindex = _INITIATE.unpack_from(data)
            self._transfer = _Transfer.NONE
            self._serve(bytearray(data))
        elif command == 3:
            if self._transfer is _Transfer.UPLOAD:
                self._serve(bytearray(data))
            else:
                self._abort(UNKNOWN_COMMAND)
        elif command == 4:
            self.reset()
        else:  # block transfers and what is not defined
            _, self._index, self._subindex = _INITIATE.unpack_from(data)
            self._abort(UNKNOWN_COMMAND)

    def response(self, data: bytes) -> None:
        """Follow what the server answers; call it with each of its responses."""
        command = data[0] >> 5
        if command == 2 and not data[0] & 0x02:
            self._transfer = _Transfer.UPLOAD
        elif (command == 0 and data[0] & 0x01) or command == 4:
            self._transfer = _Transfer.NONE

    def _initiate_download(self, data: bytes) -> None:
        _, self._index, self._subindex = _INITIATE.unpack_from(data)
        self._transfer = _Transfer.NONE
        if not data[0] & 0x02:
            self._size = int.from_bytes(data[4:], "little") if data[0] & 0x01 else None
            if self._size is not None and self._size > MAX_DOWNLOAD_BYTES:
                self._abort(OUT_OF_MEMORY)
                return
            self._received = 0
            self._transfer = _Transfer.DOWNLOAD
        self._serve(bytearray(data))

    def _download_segment(self, data: bytes) -> None:
        if self._transfer is not _Transfer.DOWNLOAD:
            self._abort(UNKNOWN_COMMAND)
            return
        last = bool(data[0] & 0x01)
        self._received += 7 - (data[0] >> 1 & 0x07)
        if self._received > MAX_DOWNLOAD_BYTES:
            self._abort(OUT_OF_MEMORY)
        elif self._size is not None and self._received > self._size:
            self._abort(TOO_LONG)
        elif last and self._size is not None and self._received < self._size:
            self._abort(TOO_SHORT)
        else:
            self._serve(bytearray(data))
            if last:
                self._transfer = _Transfer.NONE

    def _abort(self, code: int) -> None:
        self._transfer = _Transfer.NONE
        self._respond(_ABORT.pack(_ABORT_COMMAND, self._index, self._subindex, code))
