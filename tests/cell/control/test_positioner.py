"""Who moves the object: the simulation, an operator, the host, or axes that really move."""

import json
import socket
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import asdict
from functools import partial
from math import radians
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

from cell.build import _axes
from cell.config.file import changed_config
from cell.config.model import CellConfig
from cell.control.axes import AxesPositioner
from cell.control.plan import GraspStep, Pose
from cell.control.positioner import (
    CallbackPositioner,
    Destination,
    OperatorPositioner,
    SimulatedPositioner,
    SocketPlacer,
)
from cell.control.states import CellState
from cell.errors import CellStateError, PositionerError, PositionerFault
from gripper.values.state import GripperPhase
from tests.cell.cells import REAL, MakeBench, once, quick_config
from tests.faults.campaign import CHANGES, ROTATION_AXIS, WRIST, X_AXIS
from tests.values import raising

POSE = Pose(x_m=1e-3, rotation_rad=1.0)


def test_operator_is_asked_and_can_stop_and_has_to_be_there() -> None:
    asked: list[str] = []
    answers = iter(["", "", "q"])

    def ask(text: str) -> str:
        asked.append(text)
        return next(answers)

    positioner = OperatorPositioner(ask)
    positioner.present("ball")
    assert positioner.move_to(POSE) == POSE
    assert "'ball'" in asked[0]
    assert "x +1.0 mm" in asked[1]
    with pytest.raises(PositionerError, match="operator stopped"):
        positioner.present(None)
    assert "the object to identify" in asked[2]
    with pytest.raises(PositionerError, match="no operator"):
        OperatorPositioner(raising(EOFError())).move_to(POSE)


OTHER = Pose(y_m=2e-3)


@pytest.mark.parametrize(
    ("answer", "reached"),
    [
        *((None, POSE), (True, POSE), (OTHER, OTHER), (False, "host refused")),
        *((wrong, "the host answered") for wrong in (0, 1, "yes")),
    ],
)
def test_host_moves_or_refuses(answer, reached: Pose | str) -> None:
    positioner = CallbackPositioner(lambda _pose: answer)
    positioner.present("ignored")
    if isinstance(reached, Pose):
        assert positioner.move_to(POSE) == reached
    else:
        with pytest.raises(PositionerError, match=reached):
            positioner.move_to(POSE)


@pytest.fixture
def placed(tmp_path: Path) -> Iterator[tuple[SocketPlacer, Callable[[bytes], Future[bytes]]]]:
    """A placer, and what answers its next request as the simulated cell, and returns it."""
    with socket.socket(socket.AF_UNIX) as listener, ThreadPoolExecutor(1) as pool:
        listener.bind(str(tmp_path / "s"))
        listener.listen(1)

        def answer(reply: bytes) -> bytes:
            with listener.accept()[0] as peer:
                asked = peer.recv(4096)
                peer.sendall(reply)
                peer.recv(1)  # until the client has ended
            return asked

        yield SocketPlacer(str(tmp_path / "s"), timeout_s=0.05), partial(pool.submit, answer)


def test_socket_placer_speaks_json_lines(placed, tmp_path) -> None:
    with pytest.raises(PositionerError, match="no simulated cell answers"):
        SocketPlacer(str(tmp_path / "none")).place("ball", POSE)
    placer, answer = placed
    request = answer(json.dumps({"ok": True, "pose": asdict(Pose(x_m=3e-3))}).encode() + b"\n")
    assert placer.place("ball", POSE) == Pose(x_m=3e-3)
    assert json.loads(request.result()) == {"place": "ball", "pose": asdict(POSE)}
    answer(b'{"error": "no such object"}\n')
    with pytest.raises(PositionerError, match="no such object"):
        placer.place("x", POSE)
    assert CallbackPositioner(print, SimulatedPositioner(placer)).blocks  # the host may take long


@pytest.mark.parametrize(
    "reply",
    [
        b'{"pose": [1, 2]}\n',
        b'{"pose": {"x_m": NaN, "y_m": 0, "rotation_rad": 0, "roll_rad": 0}}\n',
        b"[" * 20_000 + b"\n",
        b"x" * 70_000,
        b"\xff\xfe\n",
        b"{",  # it does not end
        b"[]\n",
    ],
)
def test_a_reply_that_is_none_is_refused(placed, reply: bytes) -> None:
    placer, answer = placed
    answer(reply)
    with pytest.raises(PositionerError, match="simulated cell "):
        placer.place("ball", POSE)


# -- The positioner with axes: a sequence on axes that really move, and what it refuses ------------


NEAR_M, NEAR_RAD = 1e-4, radians(1.0)
AWAY = Pose(x_m=2e-3, rotation_rad=radians(30.0), roll_rad=radians(40.0))


@pytest.fixture
def config() -> CellConfig:
    """The axes of the fault campaign; the one along x needs no way to find its home."""
    axes = [X_AXIS | {"homing": "here", "home": 0.0}, ROTATION_AXIS, WRIST]
    changes = CHANGES | {"positioner": {"kind": "axes", "axes": axes}}
    return quick_config(**{path.replace(".", "__"): value for path, value in changes.items()})


@pytest.fixture
def bench(make_bench: MakeBench, config: CellConfig) -> Any:
    return make_bench(config)


def true_pose(bench: Any) -> dict[str, float]:
    """Where the axes really are, as values of a pose."""
    axes = bench.simulated.devices.axes
    values = {"x_m": "x", "rotation_rad": "rotation", "roll_rad": "roll"}
    return {name: axes[axis].position for name, axis in values.items()} | {"y_m": 0.0}


def test_axes_of_a_real_cell_have_a_bus_and_a_port_and_objects_are_brought(monkeypatch) -> None:
    monkeypatch.setattr("cell.build.open_bus", bus := Mock())
    monkeypatch.setattr("cell.build.close_bus", closed := Mock())
    monkeypatch.setattr("cell.build.SerialStream", port := Mock())
    axes = [X_AXIS, ROTATION_AXIS, WRIST | {"port": "/dev/ttyUSB4"}]
    can = {"interface": "socketcan", "channel": "can1"}
    axes_on_ports = {"positioner": {"kind": "axes", "can": can, "axes": axes}}
    real = changed_config(CellConfig(), REAL | CHANGES | axes_on_ports)
    placer, idle = Mock(), lambda: GripperPhase.IDLE
    with ExitStack() as undo:
        positioner = _axes(real, None, placer, None, undo, phase=idle)
        assert bus.call_args.args == ("socketcan", "can1")
        assert port.call_args.args[0] == "/dev/ttyUSB4"
        positioner.present("box")
        placer.place.assert_called_once_with("box", Pose())
    port.return_value.close.assert_called_once()
    closed.assert_called_once_with(bus.return_value)


def test_the_axes_carry_an_object_out_of_the_pads_and_back_until_it_is_taken_off(bench) -> None:
    bench.ready("ball")
    devices = bench.simulated.devices
    for slipped_m in (0.5, 0.0):
        devices.axes["x"].slipped = slipped_m
        bench.sleep(0.1)
        assert (devices.world.placed is None) is (slipped_m > 0.0)
    bench.simulated.place("nothing")
    bench.controller.moves.positioner.move_to(AWAY)
    assert devices.world.placed is None


def test_no_axis_moves_while_the_fingers_hold(bench: Any) -> None:
    bench.ready()
    positioner = bench.controller.moves.positioner
    assert isinstance(positioner, AxesPositioner)
    there = Destination(label="ball", place="bin", pose=AWAY)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(positioner, "phase", lambda: GripperPhase.HOLDING)
        patch.setattr(positioner.axes, "ready", False)
        with pytest.raises(PositionerError, match="homed before they go to bin"):
            positioner.carry_to(there)
    for phase in GripperPhase:
        positioner.phase = lambda phase=phase: phase
        if phase in (GripperPhase.OFF, GripperPhase.IDLE):
            positioner.move_to(Pose())
            continue
        before = true_pose(bench)
        with pytest.raises(PositionerError, match=f"the fingers are {phase.value}: axes move only"):
            positioner.move_to(AWAY)
        if phase is not GripperPhase.HOLDING:
            with pytest.raises(PositionerError, match="axes move only while the fingers rest"):
                positioner.carry_to(there)
        assert true_pose(bench) == before


def test_the_axes_carry_and_bring_parts_and_refuse_poses_out_of_reach(bench: Any) -> None:
    there = Destination(label="ball", place="bin", pose=Pose(x_m=5e-3, roll_rad=1.0))
    bench.ready()
    with pytest.raises(CellStateError):
        bench.controller.moves.carry_to(there)
    bench.controller.grip(3.0, Pose(x_m=1e-3))
    bench.idle(0.5)
    held = bench.grip_n
    assert held > 1.0
    bench.controller.moves.carry_to(there)
    assert true_pose(bench)["x_m"] == pytest.approx(5e-3, abs=NEAR_M)
    assert bench.grip_n == pytest.approx(held, abs=0.3)
    with pytest.raises(PositionerError, match="no pose for bin, the place of ball"):
        bench.controller.moves.carry_to(Destination(label="ball", place="bin"))
    with pytest.raises(PositionerError, match=r"its limits are -6.00 mm"):
        bench.controller.moves.carry_to(Destination(label="ball", place="far", pose=Pose(x_m=0.1)))
    assert bench.grip_n == pytest.approx(held, abs=0.3)
    bench.controller.release()
    for pose, words in (
        (Pose(y_m=1e-3), "asks for y, which no axis moves; nothing has moved"),
        (Pose(x_m=7e-3), "axis x was asked for 7.00 mm, its limits are -6.00 mm to 6.00 mm"),
    ):
        with pytest.raises(PositionerError, match=words):
            bench.grasp(3.0, pose)
    assert true_pose(bench)["x_m"] == pytest.approx(5e-3, abs=NEAR_M)
    assert bench.controller.life.state is CellState.IDLE
    bench.controller.moves.present("box")
    assert asdict(bench.grasp(3.0, AWAY).reached) == pytest.approx(asdict(AWAY), abs=NEAR_RAD)
    assert true_pose(bench) == pytest.approx(asdict(AWAY), abs=NEAR_RAD)
    label, placed = bench.simulated.world.placed
    assert (label, placed.x_m) == ("box", pytest.approx(AWAY.x_m, abs=NEAR_M))
    assert placed.rotation_rad == pytest.approx(AWAY.rotation_rad, abs=NEAR_RAD)


def test_a_drive_that_fails_in_a_carry_leaves_the_part_in_the_grip(bench: Any) -> None:
    bench.ready()
    bench.controller.grip(3.0, Pose())
    bench.simulated.inject("axis2.fault")
    there = Destination(label="ball", place="bin", pose=Pose(x_m=5e-3))
    with pytest.raises(PositionerFault, match="drive 12"):
        bench.controller.moves.carry_to(there)
    assert bench.controller.life.state is CellState.ABORTED
    assert bench.controller.life.status.fault_number == 606
    bench.sleep(1.0)
    assert bench.grip_n > 1.0
    assert not any(axis.moving for axis in bench.simulated.devices.axes.values())


def test_the_fingers_are_supervised_while_the_axes_move(bench: Any) -> None:
    """A servo of the gripper that falls silent on the way stops the axes as well."""
    bench.ready().grasp(3.0, Pose(x_m=-5e-3))
    axes = bench.simulated.devices.axes
    once(bench.clock, lambda: axes["x"].moving, lambda: bench.inject("servo2.off"))
    with pytest.raises(Exception, match="servo"):
        bench.controller.grasp(GraspStep(pose=Pose(x_m=5e-3), force_n=3.0))
    assert bench.controller.life.state is CellState.ABORTED
    assert bench.controller.life.status.fault_number == 103
    assert axes["x"].position < 4e-3
    bench.sleep(0.3)
    assert not any(axis.moving for axis in axes.values())
