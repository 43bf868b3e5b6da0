"""Properties over structured bad input: whatever shape it has, it is refused or changes nothing."""

import io
import json
import zipfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from benchmarks._fuzz_servo import Clock, Line
from cell.config import CellConfig
from cell.config_file import parse_config
from cell.dataset import read_dataset
from cell.errors import ConfigError, DatasetError
from gripper.packet_handler import CheckedPacketHandler
from gripper.port import SdkPort
from simulator.assembly import CellDevices
from simulator.commands import CellCommands
from simulator.errors import SimulatorError
from simulator.protocol2 import encode_status
from simulator.settings import SimulatorSettings
from tactile.assembler import FrameAssembler
from tactile.protocol import FrameFormat, encode_frame

relaxed = settings(
    max_examples=80,
    derandomize=True,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
json_values = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(10**400), 10**400)
    | st.floats()
    | st.text(max_size=6),
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3)
    ),
    max_leaves=8,
)
packets = st.tuples(st.integers(0, 252), st.sampled_from((0, 0x80, 4)), st.binary(max_size=12))


@relaxed
@given(st.lists(st.binary(max_size=14) | packets, max_size=6), st.integers(1, 20))
def test_packets_between_any_bytes_are_found_and_nothing_else(
    stream: list[bytes | tuple[int, int, bytes]], piece: int
) -> None:
    clock = Clock()
    line = Line(clock)
    port = SdkPort(line, clock, baudrate=1_000_000, return_delay_s=0.0, allowance_s=0.0)
    handler = CheckedPacketHandler()
    sent = [entry for entry in stream if isinstance(entry, tuple)]
    wire = b"".join(e if isinstance(e, bytes) else encode_status(*e) for e in stream)
    for at in range(0, len(wire), piece):
        line.arrive(wire[at : at + piece], 0.0)
    found = []
    while True:
        port.setPacketTimeoutMillis(1.0)
        status = handler.receive(port)
        if status is None:
            break
        found.append((status.servo_id, status.error | 0x80 * status.alert, status.data))
    assert found == sent


FORMAT = FrameFormat(n_taxels=9, sample_bytes=2)
COUNTS = [np.arange(9, dtype=np.uint16) * (k + 1) for k in range(6)]
MESSAGES = [
    message for k, counts in enumerate(COUNTS) for message in encode_frame(FORMAT, counts, k, k)
]


@relaxed
@given(st.lists(st.sampled_from(MESSAGES) | st.binary(max_size=9), max_size=60))
def test_any_order_of_messages_gives_sent_frames_only(messages: list[bytes]) -> None:
    assembler = FrameAssembler(FORMAT)
    last = -1
    for data in messages:
        frame = assembler.push(data, len(data), 0.0)
        if frame is not None:
            assert np.array_equal(frame.counts, COUNTS[frame.counter])
            assert frame.status == frame.counter > last
            last = frame.counter


@relaxed
@given(st.dictionaries(st.sampled_from([*CellConfig.model_fields, "x", "1"]), json_values))
def test_any_values_in_a_config_are_refused_or_valid(data: dict[str, object]) -> None:
    text = json.dumps(data)
    try:
        config = parse_config(text, source="x")
    except ConfigError:
        return
    json.dumps(config.model_dump(mode="json"), allow_nan=False)


COMMANDS = ("place", "remove", "play", "state", "fault", "servo", "emergency", "unplug")


@pytest.fixture(scope="module")
def commands() -> CellCommands:
    devices = CellDevices(SimulatorSettings())
    devices.unit.connect(lambda ready_s, _can_id, _burst: ready_s)
    devices.unit.advance(0.1)
    return CellCommands(devices, {}, lambda: 0.1)


@relaxed
@given(
    name=st.sampled_from(COMMANDS),
    value=json_values | st.sampled_from(["can.drop_rate", "unit.stuck_taxels", "box", True, 1]),
    rest=st.dictionaries(st.sampled_from(["value", "pose", "do"]), json_values),
)
def test_any_request_is_refused_or_answered_in_plain_numbers(
    commands: CellCommands, name: str, value: object, rest: dict[str, object]
) -> None:
    try:
        reply = commands({name: value, **rest})
    except SimulatorError:
        return
    json.dumps(reply)


headers = st.fixed_dictionaries(
    {
        "descr": st.sampled_from(["<f8", "<U4", "|O", "<U0", "<i8", ">u2", "|V8", "<m8[s]"])
        | st.lists(st.tuples(st.just("a"), st.just("<f8")), max_size=2)
        | st.none(),
        "shape": st.lists(st.integers(-2, 10**13), max_size=4).map(tuple) | st.none() | st.text(),
        "fortran_order": st.booleans() | st.none(),
    }
)


@relaxed
@given(headers, st.binary(max_size=64))
def test_any_array_header_is_refused_or_fits_its_bytes(
    tmp_path: Path, header: dict[str, object], body: bytes
) -> None:
    text = repr(header).encode()
    npy = b"\x93NUMPY\x01\0" + len(text).to_bytes(2, "little") + text + body
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        archive.writestr("counts.npy", npy)
    path = tmp_path / "x.npz"
    path.write_bytes(stream.getvalue())
    with pytest.raises(DatasetError):
        read_dataset(path)
