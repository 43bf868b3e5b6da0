"""The fixtures in virtual time, used as a downstream project uses them."""

from typing import Any

import numpy as np
import pytest

from cell.control.plan import Pose
from cell.control.states import CellState
from cell.errors import CellStateError, ConfigError, PositionerError
from cell.recording.reader import read_recording
from gripper.errors import BusTimeout
from simulator.errors import SimulatorSettingsError
from tactile.errors import FrameTimeout
from tests.cell.conftest import COARSE_PADS

PIN = {"pin": "cylinder:diameter=6mm,length=20mm"}
QUICK = {
    "tactile.tare_frames": 25,
    "tactile.layout": COARSE_PADS,
    "gripper.approach_speed_mm_s": 20.0,
}
SHORT = QUICK | {"sequence.force_n": [2.0, 3.0], "sequence.max_grasps": 2}
REAL = """
gripper: {port: /dev/ttyUSB7, servos: [{id: 11}, {id: 12}], force_max_n: 9.0}
tactile: {interface: socketcan, channel: can7, node_id: 9}
positioner: {kind: operator}
"""


@pytest.mark.slow
def test_a_cell_grasps_an_object_of_the_test(simulated_cell) -> None:
    cell = simulated_cell(objects=PIN, changes=QUICK)
    assert cell.controller.life.state.value == "STOPPED"
    record = cell.start("pin").grasp(force_n=3.0)
    assert record.outcome.final_force_n == pytest.approx(3.0, abs=0.5)
    assert cell.grip_n == 0.0
    assert cell.aperture_m > 0.015


@pytest.mark.slow
def test_the_seed_decides_what_is_measured(simulated_cell) -> None:
    def counts(seed: int) -> Any:
        return simulated_cell(objects=PIN, seed=seed, changes=QUICK).start("pin").grasp().grasp

    one, same, other = counts(1), counts(1), counts(2)
    assert np.array_equal(one.counts, same.counts)
    assert not np.array_equal(one.counts[0], other.counts[0])


def test_a_config_of_a_real_cell_is_simulated_with_its_own_ids_and_limits(
    simulated_cell, tmp_path
) -> None:
    path = tmp_path / "cell.yaml"
    path.write_text(REAL)
    cell = simulated_cell(path, changes=QUICK)
    assert cell.config.simulated
    assert (cell.config.gripper.force_max_n, cell.config.positioner.kind) == (9.0, "simulated")
    assert [servo.servo_id for servo in cell.simulated.settings.servos] == [11, 12]
    assert cell.start().cell.controller.hand.statistics.source.frames.complete > 0


@pytest.mark.slow
def test_a_mover_takes_the_place_of_the_positioner(simulated_cell) -> None:
    moved: list[Pose] = []
    cell = simulated_cell(objects=PIN, mover=moved.append, changes=QUICK)
    cell.start("pin").grasp(pose=Pose(x_m=1e-3))
    assert moved == [Pose(x_m=1e-3)]


@pytest.mark.slow
def test_a_recording_is_made_on_request(simulated_cell, tmp_path) -> None:
    cell = simulated_cell(objects=PIN, changes=QUICK, folder=tmp_path)
    cell.start("pin").grasp()
    cell.cell.close()
    assert len(read_recording(cell.cell.recording_path).grasps) == 1


@pytest.mark.long
def test_objects_are_taught_and_told_apart(simulated_cell) -> None:
    cell = simulated_cell(objects=PIN | {"ball": "sphere:diameter=9.5mm"}, changes=SHORT).start()
    recognizer = cell.teach(["pin", "ball"], grasps=5)
    assert cell.identify(recognizer, "pin").label == "pin"
    assert cell.identify(recognizer, "ball").label == "ball"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"changes": {"tactile.frames": 25}}, "no value 'tactile.frames'"),
        ({"changes": {"tactile.tare_frames.n": 25}}, "no value 'tactile.tare_frames.n'"),
        ({"changes": {"tactile.tare_frames": 1}}, "tactile.tare_frames"),
        ({"objects": {"thing": "blob"}}, "thing"),
    ],
)
def test_settings_that_cannot_be_are_refused(simulated_cell, arguments, message) -> None:
    with pytest.raises(ConfigError, match=message):
        simulated_cell(**arguments)


def test_time_passes_only_while_somebody_waits(simulated_cell) -> None:
    cell = simulated_cell(objects=PIN, changes=QUICK).start("pin")
    before_s, frames = (
        cell.clock.monotonic(),
        cell.cell.controller.hand.statistics.source.frames.complete,
    )
    cell.idle(0.5)
    assert cell.clock.monotonic() - before_s == pytest.approx(0.5, abs=0.02)
    assert cell.cell.controller.hand.statistics.source.frames.complete - frames >= 20
    cell.sleep(0.05)
    assert cell.clock.monotonic() - before_s == pytest.approx(0.55, abs=0.02)


def test_both_links_have_the_same_devices_behind_them(
    servo_bus, servo_clock, can_bus, can_clock, cell_bench
) -> None:
    assert servo_clock is can_clock is cell_bench.simulated.clock
    assert servo_bus.ping(1).model_number == 1020
    boot_up = can_bus.recv(1.0)
    assert (boot_up.arbitration_id, bytes(boot_up.data)) == (0x705, b"\0")
    assert can_clock.monotonic() == pytest.approx(boot_up.timestamp)


def test_bytes_and_transactions_share_the_line(servo_bus, servo_stream) -> None:
    servo_stream.write(b"\xff\xff\xfd\x00\x01\x03\x00\x01\x19\x4e")  # a ping, from the manual
    answer = servo_stream.read(64, 0.05)
    assert answer[:5] == b"\xff\xff\xfd\x00\x01"
    assert servo_bus.statistics.transactions == 0


def test_a_fault_acts_until_it_is_cleared(servo_bus, inject_fault) -> None:
    fault = inject_fault("servo1.off")
    with pytest.raises(BusTimeout):
        servo_bus.ping(1)
    assert fault.began_s is not None
    fault.clear()
    assert servo_bus.ping(1).servo_id == 1


def test_a_fault_that_does_not_exist_is_refused_with_what_there_is(
    simulated_cell, inject_fault
) -> None:
    simulated_cell(changes=QUICK)
    with pytest.raises(SimulatorSettingsError, match=r"no fault 'can\.los'.*can\.loss"):
        inject_fault("can.los=0.1")


def test_the_cell_is_named_where_a_test_has_several(simulated_cell, inject_fault) -> None:
    with pytest.raises(pytest.fail.Exception, match="0 simulated cells so far; make one first"):
        inject_fault("can.loss=0.5")
    one, two = simulated_cell(), simulated_cell()
    with pytest.raises(pytest.fail.Exception, match="2 simulated cells; name one"):
        inject_fault("servos.unplugged")
    inject_fault("servos.unplugged", into=two)
    assert not one.simulated.injector.faults
    assert two.simulated.injector.faults
    with pytest.raises(pytest.fail.Exception, match="not a simulated cell of this test"):
        inject_fault("servos.unplugged", into=one.simulated)


@pytest.mark.parametrize("label", ["washer", "cylinder:diameter=6"])
def test_an_object_that_nobody_has_is_refused_at_once(simulated_cell, label) -> None:
    cell = simulated_cell(objects=PIN, changes=QUICK).start()
    expected = "'washer'; there are pin" if label == "washer" else "is not NAME=LENGTH with a unit"
    with pytest.raises(PositionerError, match=expected):
        cell.controller.moves.present(label)
    assert cell.controller.life.state is CellState.IDLE
    with pytest.raises(PositionerError, match=expected):
        simulated_cell(objects=PIN, changes=QUICK).start(label)


@pytest.mark.slow
def test_a_host_program_teaches_identifies_and_sorts_on_the_runtime(
    cell_runtime, inject_fault
) -> None:
    moved: list[Pose] = []
    objects = PIN | {"ball": "sphere:diameter=9.5mm"}
    cell = cell_runtime(objects=objects, changes=SHORT, mover=moved.append)
    with pytest.raises(CellStateError, match=r"as `present` \(`--object`\), one of pin, ball"):
        cell.run({"task": "teach", "label": "nut", "grasps": 3})
    for label in objects:
        cell.run({"task": "teach", "label": label, "grasps": 4})
    assert len(moved) == 8
    with pytest.raises(ConfigError, match="'washer'; there are pin, ball; or write a shape"):
        cell.start({"task": "identify", "present": "washer"})
    with pytest.raises(ConfigError, match="'washer'; there are pin, ball; or write a shape"):
        cell.start({"task": "sort", "feed": ["pin", "washer"]})
    answer = cell.run({"task": "identify", "present": "pin", "keep": "always"})
    assert (answer.label, cell.grip_n() > 2.0) == ("pin", True)
    cell.release()
    assert cell.run({"task": "identify"}).presented == "pin"  # the part that is still there
    cell.ask(remove=True)
    with pytest.raises(CellStateError, match="name a part as `present`, one of pin, ball"):
        cell.start({"task": "identify"})
    assert cell.run({"task": "sort", "parts": 2}).places == {"pin": 1, "ball": 1, "reject": 0}

    lost = inject_fault("can.loss=1@contact+0.1s", into=cell)
    assert lost.began_s is None
    with pytest.raises(FrameTimeout):
        cell.run({"task": "identify", "present": "ball"})
    assert lost.began_s is not None
    cell.close()
    assert lost.began_s is None
