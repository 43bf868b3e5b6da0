"""Modbus TCP: frames and functions 3, 4, 6, 16, 23 as pure functions, and a server on asyncio.

From the Modbus Application Protocol V1.1b3 and the TCP guide V1.0b.
"""

import asyncio
import struct
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Protocol

from cell.config.serve import ServeConfig
from cell.interfaces.access import ACCEPTED_AT_ONCE, Listener, may_connect

ILLEGAL_FUNCTION, ILLEGAL_ADDRESS, ILLEGAL_VALUE, DEVICE_FAILURE, DEVICE_BUSY = 1, 2, 3, 4, 6
"""Exception codes."""
_HEADER = struct.Struct(">HHHB")
"""Transaction, protocol (0), number of following bytes including the unit, unit."""
_LONGEST = 254
"""Largest length field of a header: unit and a request of 253 bytes."""
_MOST_READ, _MOST_WRITE, _MOST_BOTH = 125, 123, 121
"""Most registers of functions 3 and 4, of 16, and of the write of 23."""
_IDLE_S = 120.0
"""Silence in s after which a connection is closed."""


class ModbusError(Exception):
    """A request gets an exception code as answer."""

    def __init__(self, code: int) -> None:
        super().__init__(f"Modbus exception {code}")
        self.code = code


class Registers(Protocol):
    """The registers behind one connection; both methods raise `ModbusError`."""

    def read(self, function: int, address: int, count: int) -> Sequence[int]:
        """Return holding (function 3) or input registers (4)."""

    def write(self, address: int, values: Sequence[int]) -> None:
        """Write holding registers, all or none."""

    def disconnected(self) -> None:
        """Handle the end of the connection."""


def answer(request: bytes, registers: Registers) -> bytes:
    """Return the answer to a request (PDU); an invalid request gets an exception code."""
    function = request[0] if request else 0
    try:
        return bytes((function,)) + _carry_out(function, request[1:], registers)
    except ModbusError as error:
        return bytes((function | 0x80, error.code))
    except Exception:
        return bytes((function | 0x80, DEVICE_FAILURE))


def _carry_out(function: int, body: bytes, registers: Registers) -> bytes:
    match function:
        case 3 | 4:
            return _read(registers, function, *_words(body, 2))
        case 6:
            address, value = _words(body, 2)
            registers.write(address, (value,))
            return body
        case 16:
            address, count = _words(body[:4], 2)
            registers.write(address, _values(body[4:], count, _MOST_WRITE))
            return body[:4]
        case 23:
            address, count, to, n_written = _words(body[:8], 4)
            written = _values(body[8:], n_written, _MOST_BOTH)
            _read(registers, 3, address, count)  # an invalid read refuses the write too
            registers.write(to, written)
            return _read(registers, 3, address, count)
        case _:
            raise ModbusError(ILLEGAL_FUNCTION)


def _words(body: bytes, count: int) -> tuple[int, ...]:
    if len(body) != 2 * count:
        raise ModbusError(ILLEGAL_VALUE)
    return struct.unpack(f">{count}H", body)


def _values(body: bytes, count: int, most: int) -> tuple[int, ...]:
    """Return the values after their count of bytes."""
    _check_count(count, most)
    if len(body) != 1 + 2 * count or body[0] != 2 * count:
        raise ModbusError(ILLEGAL_VALUE)
    return _words(body[1:], count)


def _check_count(count: int, most: int) -> None:
    if not 1 <= count <= most:
        raise ModbusError(ILLEGAL_VALUE)


def _read(registers: Registers, function: int, address: int, count: int) -> bytes:
    _check_count(count, _MOST_READ)
    values = registers.read(function, address, count)
    return struct.pack(f">B{count}H", 2 * count, *values)


class ModbusServer:
    """Serves registers over TCP to hosts that may connect. Raises OSError if it cannot listen.

    Parameters
    ----------
    config
        Address, allow-list, and longest time for the rest of a request, and for the client to take
        its answer.
    port
        TCP port; 0: any free one.
    connect
        Returns the registers for a client at that host.
    """

    def __init__(self, config: ServeConfig, port: int, connect: Callable[[str], Registers]) -> None:
        self._config, self._connect = config, connect
        self._listener = Listener(config.listen, port)
        self.port, self.close = self._listener.port, self._listener.close
        self._over = asyncio.Event()

    async def serve(self) -> None:
        """Answer clients until `end`; the end of the loop cancels the remaining connections."""
        server = await asyncio.start_server(
            self._serve, sock=self._listener, backlog=ACCEPTED_AT_ONCE
        )
        await self._over.wait()
        server.close()

    def end(self) -> None:
        """End `serve`."""
        self._over.set()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        peer = writer.get_extra_info("peername")
        if peer is None or not may_connect(peer[0], self._config):
            writer.close()
            return
        registers = self._connect(peer[0])
        try:
            # Incomplete, late or invalid bytes end the connection: the next request cannot be
            # located. So does the end of the server.
            with suppress(
                asyncio.IncompleteReadError, TimeoutError, OSError, asyncio.CancelledError
            ):
                while await self._one_request(reader, writer, registers):
                    self._listener.note_request(peer)
        finally:
            registers.disconnected()
            writer.transport.abort()

    async def _one_request(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, registers: Registers
    ) -> bool:
        """Answer one request; return False if the bytes are not Modbus."""
        async with asyncio.timeout(_IDLE_S):
            first = await reader.readexactly(1)
        async with asyncio.timeout(self._config.request_timeout_s):
            header = first + await reader.readexactly(_HEADER.size - 1)
            transaction, protocol, length, unit = _HEADER.unpack(header)
            if protocol != 0 or not 2 <= length <= _LONGEST:
                return False
            reply = answer(await reader.readexactly(length - 1), registers)
            writer.write(_HEADER.pack(transaction, 0, len(reply) + 1, unit) + reply)
            await writer.drain()
            await asyncio.sleep(0)  # buffered requests would keep all other clients waiting
        return True
