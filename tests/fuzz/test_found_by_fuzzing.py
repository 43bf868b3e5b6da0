"""What the fuzzing found, kept as examples."""

import io
import json
import os
import time
import tracemalloc
import zipfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from benchmarks import _fuzz_archives, _fuzz_recording
from benchmarks._fuzz_can import SdoClientTrial
from benchmarks._fuzz_servo import Clock, Line
from cell.config_file import MAX_BYTES, parse_config
from cell.dataset import read_dataset
from cell.errors import ConfigError, DatasetError, ModelError
from cell.files import savez
from cell.model import _digest, load_model
from cell.recording import read_recording
from gripper.packet_handler import CheckedPacketHandler
from gripper.port import SdkPort
from simulator.assembly import CellDevices
from simulator.commands import CellCommands
from simulator.errors import SimulatorSettingsError
from simulator.mesh import load_mesh
from simulator.protocol2 import encode_status
from simulator.settings import SimulatorSettings
from simulator.slcan import SlcanAdapter
from tactile.can_bus import BulkSlcanBus
from tactile.errors import NodeMissing


def test_packets_behind_a_damaged_length_are_all_found() -> None:
    clock = Clock()
    line = Line(clock)
    port = SdkPort(line, clock, baudrate=1_000_000, return_delay_s=0.0, allowance_s=0.0)
    handler = CheckedPacketHandler()
    first = bytearray(encode_status(1, 0, b"ab"))
    first[5] = 40
    line.arrive(bytes(first) + encode_status(2, 0, b"cd") + encode_status(3, 0, b"ef"), 0.0)
    found = []
    for _ in range(3):
        port.setPacketTimeoutMillis(1.0)
        found.append(handler.receive(port))
    assert [status and (status.servo_id, status.data) for status in found] == [
        (2, b"cd"),
        (3, b"ef"),
        None,
    ]


def test_what_followed_an_answer_is_forgotten_with_the_next_request() -> None:
    clock = Clock()
    line = Line(clock)
    port = SdkPort(line, clock, baudrate=1_000_000, return_delay_s=0.0, allowance_s=0.0)
    handler = CheckedPacketHandler()
    first = bytearray(encode_status(1, 0, b"ab"))
    first[5] = 40
    line.arrive(bytes(first) + encode_status(2, 0, b"cd") + encode_status(2, 0, b"old"), 0.0)
    port.setPacketTimeoutMillis(1.0)
    assert handler.receive(port) is not None
    handler.send(port, 2, 2, b"\0\0\4\0")
    port.setPacketTimeoutMillis(1.0)
    assert handler.receive(port) is None


@pytest.fixture
def unit() -> Iterator[SdoClientTrial]:
    trial = SdoClientTrial()
    yield trial
    trial.close()


def test_an_object_without_an_end_is_given_up(unit: SdoClientTrial) -> None:
    trial = unit
    begin_s = trial.clock.now_s
    assert trial.check((0x1008, 0, b"", [], True)) == "refused: NodeMissing"
    assert trial.clock.now_s == begin_s


def test_an_object_shorter_than_announced_is_refused(unit: SdoClientTrial) -> None:
    trial = unit
    answers = iter([b"\x41\x08\x10\0\x14\0\0\0", b"\x0dabcdefg"[:2] + bytes(6)] * 3)
    trial.bus.on_send = lambda message: trial.client.on_response(0x585, next(answers), 0.0)
    with pytest.raises(NodeMissing, match="1 bytes came, 20 were announced"):
        trial.objects.read(0x1008)


@pytest.mark.parametrize(
    "line",
    [b"t1818112233", b"t1_0211AA", b"t+181 0", b"tFFF0", b"TFFFFFFFF0", b"t1811AABB", b"d1810"],
)
def test_a_line_that_is_not_whole_is_no_message(line: bytes) -> None:
    master, slave = os.openpty()
    bus = BulkSlcanBus(os.ttyname(slave), bitrate=1_000_000, tty_baudrate=1_000_000)
    try:
        os.write(master, line + b"\rt1811AA\r")
        message = bus.recv(1.0)
        assert message is not None
        assert bytes(message.data) == b"\xaa"
        assert bus.recv(0) is None
        assert bus.bad_lines == 1
    finally:
        bus.shutdown()
        os.close(slave)
        os.close(master)


def test_the_end_of_an_overlong_line_is_no_message() -> None:
    master, slave = os.openpty()
    bus = BulkSlcanBus(os.ttyname(slave), bitrate=1_000_000, tty_baudrate=1_000_000)
    try:
        for part in (b"x" * 40, b"t1811AA\r", b"t1821BB\r"):
            os.write(master, part)
            time.sleep(0)
            last = bus.recv(0)
        assert last is not None
        assert last.arbitration_id == 0x182
        assert bus.bad_lines == 1
    finally:
        bus.shutdown()
        os.close(slave)
        os.close(master)


def test_the_adapter_takes_no_end_of_an_overlong_line() -> None:
    sent = []

    class Wire:
        faults = None

        def send(self, can_id: int, data: bytes, now_s: float, *, extended: bool) -> None:
            sent.append((can_id, data))

        def clear(self) -> None: ...

    adapter = SlcanAdapter(Wire(), bitrate=1_000_000)  # type: ignore[arg-type]
    for part in (b"O\r", b"9" * 40, b"9" * 40, b"t1811AA\r", b"t1821BB\r"):
        adapter.receive(part, 0.0)
    assert sent == [(0x182, b"\xbb")]


def test_an_integer_beyond_any_float_is_refused() -> None:
    commands = CellCommands(CellDevices(SimulatorSettings()), {}, lambda: 0.0)
    with pytest.raises(SimulatorSettingsError, match="must be a finite number"):
        commands({"fault": "servo_wire.delay_s", "value": 10**400})


def test_a_pose_beyond_the_cell_is_refused() -> None:
    commands = CellCommands(CellDevices(SimulatorSettings()), {}, lambda: 0.0)
    with pytest.raises(SimulatorSettingsError, match="y_m is 1e\\+308, limit 100 m"):
        commands({"place": "ball", "pose": {"y_m": 1e308}})


@pytest.mark.parametrize("text", ["? [1, 2]\n: 3\n", "2001-01-01: 3\n"])
def test_keys_that_are_no_text_are_refused(text: str) -> None:
    with pytest.raises(ConfigError, match="no plain text"):
        parse_config(text, source="x")


@pytest.mark.parametrize(
    "text",
    [
        "[" * 20_000,
        "".join(f"key{i}: 1\n" for i in range(4500)),
        "a: b\n" * 12_000,
        "x" * (MAX_BYTES + 1),
    ],
    ids=["brackets", "keys", "same key", "long"],
)
def test_a_config_that_would_take_minutes_is_refused_soon(text: str) -> None:
    begin_s = time.process_time()
    with pytest.raises(ConfigError) as error:
        parse_config(text, source="x")
    assert time.process_time() - begin_s < 10.0
    assert len(str(error.value)) < 5000


def archive(folder: Path, method: int, members: dict[str, bytes]) -> Path:
    path = folder / "x.npz"
    with zipfile.ZipFile(path, "w", method) as file:
        for name, data in members.items():
            file.writestr(name, data)
    return path


@pytest.mark.parametrize("method", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_packings_that_unpack_without_a_bound_are_refused(tmp_path: Path, method: int) -> None:
    path = archive(tmp_path, method, {"counts.npy": bytes(30 << 20)})
    data = bytearray(path.read_bytes())
    directory = data.rindex(b"PK\x01\x02")
    data[directory + 24 : directory + 28] = (100).to_bytes(4, "little")
    path.write_bytes(data)
    tracemalloc.start()
    try:
        with pytest.raises(DatasetError, match="packed by method"):
            read_dataset(path)
        assert tracemalloc.get_traced_memory()[1] < 4 << 20
    finally:
        tracemalloc.stop()


def test_an_archive_that_lost_an_optional_array_is_refused(tmp_path: Path) -> None:
    data = bytearray(_fuzz_archives.DatasetTrial().data)
    last = data.rindex(b"PK\x01\x02")
    before = data.rindex(b"PK\x01\x02", 0, last)
    # The comment of one entry swallows the entry behind it, which is the source of the grasps.
    data[before + 32 : before + 34] = (data.rindex(b"PK\x05\x06") - last).to_bytes(2, "little")
    path = tmp_path / "x.npz"
    path.write_bytes(data)
    with zipfile.ZipFile(path) as archive:
        assert "source.npy" not in archive.namelist()
    with pytest.raises(DatasetError, match="12 arrays found, 13 stated"):
        read_dataset(path)


def test_texts_without_a_size_are_refused(tmp_path: Path) -> None:
    header = b"{'descr': '<U0', 'fortran_order': False, 'shape': (300000000,), }"
    npy = b"\x93NUMPY\x01\0" + len(header).to_bytes(2, "little") + header
    tracemalloc.start()
    try:
        with pytest.raises(DatasetError, match="has no size"):
            read_dataset(archive(tmp_path, zipfile.ZIP_STORED, {"label.npy": npy}))
        assert tracemalloc.get_traced_memory()[1] < 4 << 20
    finally:
        tracemalloc.stop()


@pytest.fixture(scope="module")
def models() -> _fuzz_archives.ModelTrial:
    return _fuzz_archives.ModelTrial()


@pytest.mark.parametrize(
    ("array", "value"),
    [
        ("pads.adc_max", np.array(np.inf)),
        ("pads.taxel_xy_m", np.full((80, 2), np.nan)),
        ("learnt.labels", np.array(["ball", "box", "x"])),
        ("learnt.labels", np.array("ball")),
    ],
)
def test_a_model_that_could_not_answer_is_refused_when_it_is_loaded(
    models: _fuzz_archives.ModelTrial, tmp_path: Path, array: str, value: np.ndarray
) -> None:
    for _, members, _ in models.kinds:
        arrays = {
            name[:-4]: np.load(io.BytesIO(member), allow_pickle=False)
            for name, member in members.items()
        }
        if array not in arrays:
            continue
        header = json.loads(str(arrays.pop("model")))
        arrays[array] = value
        header["sha256"] = _digest(arrays)
        path = tmp_path / "x.npz"
        with path.open("wb") as file:
            savez(file, {"model": np.array(json.dumps(header)), **arrays})
        with pytest.raises(ModelError):
            load_model(path, models.pads)


def test_a_recording_with_content_behind_its_end_is_not_complete(tmp_path: Path) -> None:
    trial = _fuzz_recording.RecordingTrial()
    records = list(trial.records)
    chunk = next(record for record in records if record[0] == 0x06)
    end = [code for code, _ in records].index(0x0F)
    path = tmp_path / "x.mcap"
    path.write_bytes(_fuzz_recording._file([*records[: end + 3], chunk, *records[end + 3 :]]))
    recording = read_recording(path)
    assert "behind its end" in recording.lost_reason
    assert len(recording.grasps) == 2
    assert len(recording.frames) == len(trial.right.frames)
    renamed = [(0xF0 if code == 0x0F else code, content) for code, content in records]
    path.write_bytes(_fuzz_recording._file(renamed))
    assert not read_recording(path).complete


@pytest.mark.parametrize(
    "text", [b"solid \xff\nendsolid", b"solid x\nvertex nan 0 0\nendsolid", b""]
)
def test_a_mesh_of_other_bytes_is_refused(tmp_path: Path, text: bytes) -> None:
    path = tmp_path / "x.stl"
    path.write_bytes(text)
    with pytest.raises(SimulatorSettingsError, match="cannot be read as STL"):
        load_mesh(path)
