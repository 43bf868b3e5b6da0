"""The cell over Modbus, with pymodbus as client; what goes wrong on the line lets nothing go."""

import itertools
import socket
import struct
import subprocess
import sys
from collections.abc import Callable
from contextlib import ExitStack
from importlib.util import find_spec
from typing import Any

import pytest

from cell.control.plan import Pose
from cell.errors import PositionerError
from cell.hand.interface import LiveValues
from cell.interfaces.modbus import registers as reg
from cell.service.service import RELEASE_KEY
from tactile.errors import FrameTimeout
from tests.cell.interfaces.hosts import BLOCK, BlockPlc, FunctionBlock, Plc
from tests.cell.served import Served
from tests.waiting import LIMIT_S, until

TEACH, IDENTIFY, GRIP, VERIFY, SORT = 20, 21, 22, 23, 24
RELEASE, REACHED, REFUSE = 30, 40, 41
CLEAR, RESET, STOP, HOLD = 9, 1, 3, 4
KEEP = 1


@pytest.fixture
def connect(serve: Any, undo: ExitStack) -> Callable[..., tuple[Served, Plc]]:
    """Return the maker of a served cell and a PLC; with a cell another PLC of the same one."""

    def make(
        served: Served | None = None, *, adopt: bool = False, **changes: Any
    ) -> tuple[Served, Plc]:
        served = served or serve("modbus", **changes)
        plc = Plc(served.interfaces["modbus_port"])
        undo.callback(plc.link.close)
        return served, plc.adopt() if adopt else plc

    return make


def text_of(inputs: list[int]) -> str:
    return struct.pack(">32H", *inputs[32:64]).rstrip(b"\0").decode("ascii")


def test_signature_life_and_bits_have_their_registers(connect) -> None:
    _, plc = connect()
    inputs = plc.inputs()
    assert (inputs[0], inputs[2]) == (reg.SIGNATURE, reg.READY)
    assert plc.inputs()[1] != inputs[1]  # the cell lives
    plc.adopt()
    assert plc.inputs()[2] == reg.READY | reg.REMOTE
    assert plc.command(IDENTIFY, 0, 0, 0, KEEP) == 0
    inputs = plc.inputs()
    assert inputs[2] == reg.REMOTE | reg.DONE | reg.HOLDING
    assert inputs[25] == reg.ANSWERED | reg.ANSWER_IN_GRIP


def test_live_values_have_their_registers(connect) -> None:
    served, plc = connect()
    names = ("force_n", "force_age_s", "opening_mm", "temperature_c", "frame_age_s")
    none = reg.NOT_MEASURED
    for *values, registers in (
        (3.256, 0.0124, 9.53, 31.2, 0.0, [326, 953, 0, 31, 12]),
        (None, 0.61, None, None, 0.41, [none, none, 410, none, 610]),
        (0.0, None, 0.0, 0.0, None, [0, 0, reg.OLDEST_MS, 0, reg.OLDEST_MS]),
        (3.0, 99.0, 40.0, 70.0, 99.0, [300, 4000, reg.OLDEST_MS, 70, reg.OLDEST_MS]),
    ):
        served.plugin.show(live=LiveValues(**dict(zip(names, values, strict=True))))
        inputs = plc.inputs()
        assert [*inputs[13:15], *inputs[21:24]] == registers


def test_a_command_runs_once_with_its_own_number_and_key_alone(connect) -> None:
    served, plc = connect(adopt=True)
    assert plc.command(GRIP, 0, 300) == 0
    # A key that stands there from an earlier command is no key of this one.
    assert plc.command(VERIFY, 0, 0, 0, 0, RELEASE_KEY) == 0
    served.ended()
    plc.seq += 1
    assert plc.write(reg.COMMAND, RELEASE) == 0
    assert plc.write(reg.COMMAND_SEQ, plc.seq) == 0
    assert plc.inputs()[6] == 513
    assert plc.inputs()[2] & reg.REFUSED
    # All outputs fall to zero, as when a PLC stops: its number is refused or runs nothing.
    plc.write(0, *[0] * 9)
    assert served.grip_n > 1.0
    assert plc.inputs()[3] == 17
    # Single writes, as a UR makes them: nothing runs before the number is written.
    plc.live()
    for address, value in ((reg.COMMAND, RELEASE), (6, RELEASE_KEY)):
        assert not plc.link.write_register(address, value).isError()
    assert plc.inputs()[8] == 2
    assert served.grip_n > 1.0
    for _ in range(2):
        assert not plc.link.write_register(reg.COMMAND_SEQ, 0xFFFF).isError()
        served.ended(3)
    assert plc.inputs()[8] == 3


def test_who_commands_writes_the_secret_first_where_there_is_one(connect, tmp_path) -> None:
    (tmp_path / "secret").write_text("seventeen.letters\n")
    served, plc = connect(serve__secret_file=str(tmp_path / "secret"))
    _, second = connect(served)
    words = struct.unpack(">9H", b"seventeen.letters\0")
    assert plc.live() == 3
    assert plc.write(32, *words[:-1]) == 0
    assert plc.live() == 3
    assert plc.write(7, 1) == 0  # anyone holds
    assert plc.write(7, 0) == 0
    for address, word in enumerate(words, start=32):  # one by one, as a UR writes
        assert not plc.link.write_register(address, word).isError()
    assert plc.link.read_holding_registers(32, count=1).exception_code == 2
    plc.adopt()
    assert second.write(reg.LIFE, 9) == 3
    plc.link.close()
    # The lease that a closed connection has left is no way round it.
    assert second.write(reg.LIFE, 10) == 3
    assert second.write(63, 0, 0) == 2
    assert second.write(32, *words, *[0] * 23) == 0
    until(lambda: second.write(reg.LIFE, 11) == 0)
    assert served.service.snapshot().commander


def test_a_frozen_life_counter_is_silence(connect) -> None:
    served, plc = connect(adopt=True)
    served.plugin.pause()
    assert plc.command(IDENTIFY) == 0
    assert plc.inputs()[2] & reg.RUNNING
    served.clock.now_s += 50.0
    plc.write(reg.LIFE, plc.life)  # written, but the same: the PLC's program stands
    served.clock.now_s += 11.0
    served.service.lease.has(0)
    assert "was silent for 61.00 s" in served.ended().error
    assert plc.inputs()[2:4] == [reg.DONE | reg.HOLDING, 11]
    # It goes on, and has to adopt the number again.
    assert plc.live() == 0
    assert plc.write(reg.COMMAND_SEQ, plc.seq + 1) == 3


def test_the_hold_register_is_a_level_of_each_client(connect) -> None:
    served, plc = connect()
    _, panel = connect(served)
    plc.adopt()
    assert panel.write(7, 1) == 0
    levels = [one.link.read_holding_registers(7, count=1).registers for one in (plc, panel)]
    assert levels == [[0], [1]]
    inputs = plc.inputs()
    assert inputs[2] == reg.READY | reg.REMOTE | reg.ON_HOLD
    assert text_of(inputs) == "on hold by Modbus 127.0.0.1"
    # A pressed button in the block of the client in command counts as well.
    plc.seq += 1
    assert plc.write(reg.COMMAND, IDENTIFY, 0, 0, 0, 0, 0, 1, plc.seq) == 0
    assert plc.inputs()[6] == 515
    assert panel.write(7, 0) == 0
    assert plc.inputs()[2] & reg.ON_HOLD
    assert plc.command(IDENTIFY) == 0  # its block has 0 in register 7
    # A block that is refused holds, too, also when its connection is gone.
    assert panel.write(0, 9, *[0] * 6, 1) == 6
    panel.link.close()
    until(lambda: "gone" in text_of(plc.inputs()))
    assert plc.command(IDENTIFY) == 515
    assert plc.command(CLEAR) == 0


def test_a_fault_has_its_bit_and_a_text_that_fits(connect) -> None:
    served, plc = connect()
    served.plugin.fail(FrameTimeout("no frame for 0.20 s; " + 60 * "x"))
    inputs = plc.inputs()
    assert inputs[2] & (reg.FAULT | reg.READY) == reg.FAULT
    assert text_of(inputs).startswith("Check the sensor's line; tactile.loss_max_share ")


def test_the_last_refusal_has_number_and_text_on_each_connection(connect) -> None:
    served, plc = connect()
    _, second = connect(served)
    assert plc.refusal() == (0, "")
    assert plc.write(reg.COMMAND, GRIP) == 6
    assert plc.refusal() == (514, "change register 0, the life counter, to get the lease")
    plc.adopt()
    assert second.write(reg.LIFE, 5) == 6
    assert second.refusal() == (514, "Modbus 127.0.0.1 is in command; wait until it ends")
    for number, refusal, cause in (
        (99, 513, "command 99 is not one of ["),
        (TEACH, 513, "object 0 has no label; serve.objects names it"),
    ):
        assert plc.command(number) == refusal
        assert plc.refusal()[1].startswith(cause)
        assert len(plc.refusal()[1]) <= 64
    assert plc.command(GRIP, 0, 60000) == 501
    assert plc.refusal()[1] == "goal grip: force_n: must be less than or equal to 50"
    assert plc.command(GRIP, 0, 300, 0, 8) == 513
    assert plc.refusal()[1] == "options 8: use bits 0 to 2"
    assert plc.command(GRIP) == 0  # with the force of the config
    assert plc.refusal()[0] == 513  # until the next one


def test_unknown_commands_objects_and_addresses_are_refused(connect) -> None:
    served, plc = connect(adopt=True)
    for number in (0, 5, 8, 10, 0x1500, 0x1E00):
        assert plc.command(number) == 513
    assert plc.command(20, 3) == 513  # two labels
    assert plc.write(8, 1, 1) == 2
    assert plc.write(9, 1) == 2
    assert plc.link.read_input_registers(132, count=5).exception_code == 2
    assert plc.link.read_holding_registers(0, count=10).exception_code == 2
    assert plc.link.read_coils(0, count=1).exception_code == 1
    assert served.plugin.job().number == 0


def test_function_23_writes_then_reads_or_does_neither(connect) -> None:
    served, plc = connect(adopt=True)

    def write_and_read(read_address: int, *values: int) -> Any:
        return plc.link.readwrite_registers(
            read_address=read_address, read_count=9, write_address=1, values=list(values)
        )

    written = [GRIP, 0, 300, 0, 0, 0, 0, plc.seq + 1]
    assert write_and_read(0, *written).registers[1:9] == written
    assert write_and_read(5, RELEASE, 0, 0, 0, 0, RELEASE_KEY, 0, 9).exception_code == 2
    assert (plc.inputs()[5], served.grip_n > 1.0) == (1, True)


def test_a_pose_has_its_registers(connect) -> None:
    served, plc = connect(adopt=True)
    served.ask_pose(Pose(x_m=0.00123, y_m=-0.0004, rotation_rad=0.5, roll_rad=-0.25))
    inputs = plc.inputs()
    assert struct.unpack(">4h", struct.pack(">4H", *inputs[17:21])) == (123, -40, 286, -143)
    assert plc.command(REACHED, inputs[16]) == 0
    assert plc.inputs()[16:21] == [0] * 5


@pytest.mark.slow
def test_a_client_that_never_reads_holds_nobody_up(connect) -> None:
    served, plc = connect(adopt=True)
    read = struct.pack(">HHHBBHH", 1, 0, 6, 1, 4, 0, 125)
    with socket.socket() as greedy:
        greedy.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        greedy.connect(("127.0.0.1", served.interfaces["modbus_port"]))
        greedy.setblocking(False)
        with pytest.raises((BlockingIOError, ConnectionError)):  # no more goes, or it has given up
            all(map(greedy.send, itertools.repeat(read * 10_000, 10_000)))
        assert plc.command(GRIP, 0, 300) == 0
        assert served.ended().verification.held


@pytest.fixture
def block(connect: Any) -> Callable[..., tuple[Served, BlockPlc]]:
    """Return the maker of a served cell and a PLC with the block; with a cell another PLC."""

    def make(served: Served | None = None, **changes: Any) -> tuple[Served, BlockPlc]:
        served, plc = connect(served, **changes)
        return served, BlockPlc(plc)

    return make


def test_the_function_block_runs_every_command_of_the_map(block) -> None:
    served, plc = block()
    assert plc.cycle()["Ready"] is False
    assert plc.ready()["Boot"] == served.service.boot
    assert plc.run(IDENTIFY, MaxGrasps=1, Options=KEEP) == (True, 0)
    assert (plc["State"], plc["Outcome"], plc["Holding"], plc["Kept"]) == (17, 4, True, True)
    assert (plc["Answered"], plc["LabelId"], plc["AnswerJob"]) == (True, 1, 1)
    assert (plc["GripForce"], plc["GripForceAge"], plc["NotRecorded"]) == (325, 5, False)
    assert plc.run(VERIFY) == (True, 0)
    assert plc.run(RESET) == (False, 505)
    assert plc.run(HOLD) == (True, 0)  # nothing runs: held once, and not Busy for ever
    assert plc.run(RELEASE) == (True, 0)
    assert (plc["Outputs"][6], served.grip_n) == (0, 0.0)
    for goal in ({"Command": TEACH, "Object": 2}, {"Command": SORT}, {"Command": 2}):
        assert plc.run(goal.pop("Command"), MaxGrasps=1, **goal) == (True, 0)
    served.plugin.pause()
    plc.ready().begin(GRIP, Force=300)
    served.plugin.fail(FrameTimeout("no frame for 0.20 s"))
    served.plugin.show(recording_fault="No space left on device")
    until(lambda: not plc.cycle()["Busy"])
    assert (plc["Done"], plc["ErrorId"]) == (False, plc["FaultNumber"])
    assert (plc["FaultNumber"], plc["State"], plc["NotRecorded"]) == (401, 9, True)
    for command, needs_reset in ((CLEAR, True), (RELEASE, True), (RESET, False), (STOP, False)):
        assert plc.run(command) == (True, 0)
        assert plc["NeedsReset"] is needs_reset
    assert plc["State"] == 2
    assert plc.run(IDENTIFY) == (False, 505)
    assert plc.run(RESET) == (True, 0)  # leaves STOPPED
    assert plc.run(99) == (False, 513)
    assert plc["State"] == 4


def test_the_function_block_stays_busy_through_the_poses_of_a_job(block) -> None:
    served, plc = block()
    for command, moved in ((REACHED, True), (REFUSE, False)):
        served.plugin.pause()
        plc.ready().begin(IDENTIFY, MaxGrasps=1)
        answer = served.ask_pose(Pose())
        seq = until(lambda: plc.cycle()["PoseSeq"])
        assert (plc["Busy"], plc["Ready"], plc["Done"]) == (True, True, False)
        plc.begin(REACHED, Object=seq + 1)
        assert (plc["ErrorId"], plc["Busy"], plc["Done"]) == (513, True, False)
        plc.begin(IDENTIFY)  # a second job is refused, the first one goes on
        assert (plc["ErrorId"], plc["Busy"]) == (505, True)
        plc.begin(command, Object=seq)
        assert answer.result(LIMIT_S) is moved
        served.plugin.go_on() if moved else served.plugin.fail(PositionerError("refused"))
        until(lambda: not plc.cycle()["Busy"])
        ended = (True, False, 0) if moved else (False, True, 510)
        assert (plc["Done"], plc["Error"], plc["ErrorId"]) == ended
    assert served.plugin.job().number == 2


def test_hold_of_the_function_block_stops_what_runs(block) -> None:
    served, plc = block()
    # By the command and by the input.
    for stop in ({"Command": HOLD, "Execute": True}, {"HoldNow": True}):
        served.plugin.pause()
        plc.ready().begin(IDENTIFY, MaxGrasps=1)
        while plc.cycle(**stop)["Busy"]:
            pass
        assert (plc["Done"], plc["ErrorId"], plc["Outcome"]) == (False, 512, 5)
        assert plc.cycle(**stop)["OnHold"] is ("HoldNow" in stop)
        plc.cycle()
        assert plc.run(RELEASE) == (True, 0)


def test_the_function_block_loses_no_edge_in_silence(block) -> None:
    served, plc = block()
    plc.cycle(Execute=True, Command=GRIP, Force=300)  # not ready yet
    assert (plc["Error"], plc["ErrorId"]) == (True, 1)
    for _ in range(5):
        plc.cycle(Execute=True)
    assert (plc["Ready"], plc["Busy"], served.plugin.job().number) == (True, False, 0)
    plc.cycle()
    plc.cycle(Execute=True, Command=GRIP, Force=300)
    plc.block.call(Connected=True, Execute=False)
    plc.block.call(Execute=True, Command=RELEASE)  # before the answer was read
    assert (plc["ErrorId"], plc["Busy"]) == (2, True)
    until(lambda: plc.cycle()["Done"])
    assert (plc["ErrorId"], served.plugin.job().task, served.grip_n > 1.0) == (0, "grip", True)
    # Held Execute is no second command.
    for _ in range(3):
        plc.cycle(Execute=True, Command=VERIFY)
    until(lambda: plc.cycle(Execute=True)["Done"])
    assert served.plugin.job().number == 2


def test_the_function_block_begins_anew_after_a_lost_connection(block) -> None:
    served, plc = block()
    plc.ready()
    served.plugin.pause()
    plc.begin(IDENTIFY, MaxGrasps=1, Options=KEEP)
    plc.cycle(Connected=False)
    assert (plc["Ready"], plc["Busy"], plc["ErrorId"]) == (False, False, 1)
    plc.plc.link.close()
    assert plc.plc.link.connect()
    served.plugin.go_on()
    plc.ready()
    assert served.plugin.job().number == 1
    # Another client takes command: the block says so, and comes back by itself.
    lease = served.service.lease.acquire("person", take=True)
    until(lambda: not plc.cycle()["Ready"])
    for _ in range(5):
        plc.cycle()
    plc.cycle(Execute=True, Command=RELEASE)
    assert (plc["ErrorId"], plc["Busy"], served.grip_n > 1.0) == (1, False, True)
    served.service.lease.give_up(lease)
    assert plc.run(RELEASE) == (True, 0)


def test_the_function_block_shows_each_bit_of_the_state() -> None:
    outputs = {
        "Holding": reg.HOLDING, "NoPart": reg.NO_PART, "PartLost": reg.LOST,
        "NotSame": reg.UNNAMED, "NeedsReset": reg.NEEDS_RESET, "OnHold": reg.ON_HOLD,
        "NotRecorded": reg.NOT_RECORDED,
    }  # fmt: skip
    block = FunctionBlock()
    for name, bit in outputs.items():
        block.call(Inputs=[reg.SIGNATURE, 0, bit, *[0] * 61])
        assert [one for one in outputs if block[one]] == [name]


def test_the_counters_of_the_function_block_begin_anew_after_65535() -> None:
    block = FunctionBlock()
    block["Outputs"][0] = 65534
    inputs = [reg.SIGNATURE, 0, reg.REMOTE, 4, 0, 65535, *[0] * 58]
    for execute in (False, False, True):
        block.call(Enable=True, Connected=True, Execute=execute, Command=VERIFY, Inputs=inputs)
    assert (block["Outputs"][0], block["Outputs"][8], block["Busy"]) == (1, 0, True)
    # Parts: what is there at the first look is none; after 65535 comes 0, after a start 1.
    new = []
    for boot, number in ((1, 0), (1, 65535), (1, 0), (1, 0), (1, 1), (2, 0), (2, 1), (2, 1)):
        block.call(Inputs=[*inputs[:27], boot, *inputs[28:]], Part=[number, *[0] * 39])
        new.append(block["NewPart"])
    assert new == [False, True, True, False, True, False, True, False]


@pytest.mark.long
@pytest.mark.skipif(find_spec("blark") is None, reason="blark is not installed")
def test_an_independent_parser_reads_the_function_block() -> None:
    command = [sys.executable, "-m", "blark", "parse", BLOCK]
    parsed = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert parsed.returncode == 0, parsed.stderr[-2000:]
