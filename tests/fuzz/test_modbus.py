"""Bad bytes at the Modbus interface: every request gets one answer, and writes all or nothing."""

import asyncio
import struct
from collections.abc import Sequence
from contextlib import closing, suppress

import pytest
from hypothesis import strategies as st

from cell.config.serve import ServeConfig
from cell.interfaces.modbus.protocol import ModbusError, ModbusServer, answer
from tests.fuzz.harness import bad_input, damages, spoilt

N = 64


class Memory:
    """Registers with their number as value; what is written is kept."""

    def __init__(self) -> None:
        self.values = list(range(N))
        self.written: list[tuple[int, Sequence[int]]] = []

    def read(self, _function: int, address: int, count: int) -> Sequence[int]:
        if address + count > N:
            raise ModbusError(2)
        return self.values[address : address + count]

    def write(self, address: int, values: Sequence[int]) -> None:
        if address + len(values) > N:
            raise ModbusError(2)
        self.written.append((address, tuple(values)))

    def disconnected(self) -> None:
        pass


def write_of(address: int, values: Sequence[int]) -> bytes:
    count = len(values)
    return struct.pack(f">BHHB{count}H", 16, address, count, 2 * count, *values)


good = (
    st.builds(struct.pack, st.just(">BHH"), st.sampled_from([3, 4, 6]), *2 * [st.integers(0, 70)])
    | st.builds(write_of, st.integers(0, 70), st.lists(st.integers(0, 0xFFFF), max_size=124))
    | st.builds(
        lambda read, write: b"\x17" + read + write[1:],
        st.builds(struct.pack, st.just(">HH"), *2 * [st.integers(0, 130)]),
        st.builds(write_of, st.integers(0, 70), st.lists(st.integers(0, 0xFFFF), max_size=122)),
    )
)
requests = st.builds(spoilt, good, damages(at_most=2)) | st.binary(max_size=253)


@bad_input(request=requests, examples=150)
def test_every_request_gets_an_answer_of_its_function_or_an_exception(request):
    memory = Memory()
    reply = answer(request, memory)
    function = request[0] if request else 0
    assert 2 <= len(reply) <= 253
    if reply[0] & 0x80:
        assert (reply[0], len(reply)) == (function | 0x80, 2)
        assert reply[1] in (1, 2, 3)
        assert memory.written == []
        return "refused"
    assert reply[0] == function
    assert len(memory.written) == (function in (6, 16, 23))
    for address, values in memory.written:
        assert 0 <= address < N
        # What is written stands in the request as it was sent: no half, no swapped value.
        assert struct.pack(f">{len(values)}H", *values) in request
    return f"function {function}"


@pytest.mark.parametrize("header", [b"\0\1\0\1\0\6\1", b"\0\1\0\0\0\1\1", b"\0\1\0\0\1\0\1"])
def test_what_is_no_modbus_is_closed_at_once(header: bytes) -> None:
    async def answered() -> bytes:
        reply = b""
        with closing(ModbusServer(ServeConfig(), 0, lambda _host: Memory())) as server:
            served = asyncio.create_task(server.serve())
            reader, writer = await asyncio.open_connection("127.0.0.1", server.port)
            writer.write(header + b"\3\0\0\0\1")
            with suppress(ConnectionResetError):
                reply = await asyncio.wait_for(reader.read(), 10.0)
            writer.close()
            server.end()
            await served
        return reply

    assert asyncio.run(answered()) == b""
