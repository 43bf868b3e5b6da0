"""From a config to a cell."""

import json
from contextlib import suppress
from typing import Any

import pytest

from cell.build import Cell, build_cell
from cell.control.plan import Pose
from cell.control.positioner import CallbackPositioner, OperatorPositioner
from cell.control.states import CellState
from cell.errors import ConfigError, PositionerError
from gripper.errors import PortLost
from gripper.values.outcome import GraspResult
from tactile.errors import BusNotOpened, TactileError
from tests.cell.commissioning.test_doctor import REAL
from tests.cell.conftest import small_config
from tests.fuzz.harness import Clock
from tests.marks import LONG

RACK = {"kind": "rack_pinion", "pinion_radius_mm": 8.0, "offset_mm": 10.0}
SLOW_RACK = {"gripper__linkage": RACK, "gripper__approach_speed_mm_s": 5.0}


def positioner(bench: Any) -> Any:
    return bench.controller.moves.positioner


@pytest.mark.slow
@pytest.mark.parametrize(
    "change",
    [
        {"gripper__servos": [{"id": 3}], **SLOW_RACK},
        # Friction of 11 N at each finger: no lower cap is sure to stop fingers that overcome it.
        SLOW_RACK | {"gripper__force_max_n": 25.0},
        {"gripper__servos": [{"id": 1, "direction": -1}, {"id": 2, "zero_pulse": 1800}]},
        {"tactile__layout": "pinch"},
        {"tactile__node_id": 127, "tactile__serial_number": 4711},
        {"sequence__ramp": {"kind": "staircase"}},
        LONG({"sequence__ramp": {"kind": "s_curve"}}),
    ],
    ids=["one servo, rack", "two servos, rack", "mounts", "pinch", "node", "stairs", "s-curve"],
)
def test_cells_of_other_make_grasp_too(make_bench, change) -> None:
    bench = make_bench(small_config(**change)).ready("box")
    record = bench.grasp(3.0)
    assert record.outcome.result is not GraspResult.NO_CONTACT
    assert record.outcome.final_force_n == pytest.approx(3.0, abs=1.5)
    assert bench.grip_n == 0.0


@pytest.mark.parametrize(
    ("kind", "complaint", "given", "made"),
    [
        ("operator", "no terminal to ask at", {"ask": lambda _text: ""}, OperatorPositioner),
        ("callback", "must pass its mover", {"mover": lambda _pose: None}, CallbackPositioner),
    ],
)
def test_a_positioner_needs_who_moves(make_bench, kind, complaint, given, made) -> None:
    config = small_config(positioner__kind=kind)
    with pytest.raises(ConfigError, match=complaint):
        make_bench(config)
    assert isinstance(positioner(make_bench(config, **given)), made)


def test_a_socket_is_used_where_one_is_named(make_bench, tmp_path) -> None:
    with pytest.raises(PositionerError, match="no simulated cell answers"):
        make_bench(small_config(positioner__socket=str(tmp_path / "s")))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "error", "name"),
    [
        ({}, BusNotOpened, "can-that-is-not-there"),
        ({"tactile__interface": "virtual"}, PortLost, "serial-that-is-not-there"),
    ],
)
def test_wrong_ports_are_named_and_nothing_stays_open(tmp_path, change, error, name) -> None:
    with pytest.raises(error, match=name):
        build_cell(small_config(**REAL | change), folder=tmp_path, ask=str)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_health_counts_what_the_links_did(make_bench, tmp_path) -> None:
    bench = make_bench(folder=tmp_path).ready()
    bench.grasp()
    health = bench.cell.health()
    assert json.loads(json.dumps(health)) == health
    assert health["tactile"]["complete"] > 50
    assert health["tactile"]["lost"] == 0
    assert health["servo_bus"]["transactions"] > 300
    assert health["loop"]["cycles"] > 100
    assert health["recording"] is None


def paced(cell: Cell, real: Clock, real_s: float) -> None:
    """Let real time pass as the worker of a plugin does while no job runs."""
    for _ in range(round(real_s / 0.02)):
        real.now_s += 0.02
        cell.idle()


@pytest.mark.slow
def test_a_paced_cell_lives_on_while_no_command_runs(make_bench) -> None:
    bench, real = make_bench().ready(), Clock()
    cell, clock = bench.cell, bench.simulated.clock
    began_s = clock.monotonic()
    cell.idle()
    cell.idle()
    assert clock.monotonic() - began_s < 0.02  # free: no time but that of the two looks
    assert cell.follow(real, 1.0) == 0.02
    began_s, ages_s = clock.monotonic(), []
    for _ in range(50):
        paced(cell, real, 0.06)
        ages_s.append(cell.controller.live.frame_age_s)
    assert clock.monotonic() - began_s == pytest.approx(3.0, abs=0.03)
    assert max(age_s for age_s in ages_s if age_s is not None) < 0.05
    assert None not in ages_s
    real.now_s += 3600.0  # the machine was asleep: an hour is not caught up
    began_s = clock.monotonic()
    cell.idle()
    assert clock.monotonic() - began_s == pytest.approx(0.2, abs=0.03)
    assert cell.follow(real, 0.0) is None
    began_s = clock.monotonic()
    paced(cell, real, 1.0)
    assert clock.monotonic() - began_s < 0.2


@pytest.mark.slow
def test_a_paced_cell_keeps_a_part_and_its_fault_and_is_ready_again(make_bench) -> None:
    bench, real = make_bench().ready(), Clock()
    cell, controller, clock = bench.cell, bench.controller, bench.simulated.clock
    cell.follow(real, 1.0)
    began_s, real_s = clock.monotonic(), real.now_s
    controller.grip(3.0, Pose())
    assert real.now_s - real_s == pytest.approx(clock.monotonic() - began_s, abs=0.02)
    paced(cell, real, 0.5)
    assert controller.life.state is CellState.COMPLETE
    assert bench.grip_n > 2.5
    bench.inject("can.off")
    with suppress(TactileError):
        paced(cell, real, 1.0)
    assert controller.life.state is CellState.ABORTED
    began_s = clock.monotonic()
    paced(cell, real, 1.0)
    assert clock.monotonic() - began_s == pytest.approx(1.0, abs=0.03)
    assert bench.grip_n > 2.5
    controller.life.clear()
    paced(cell, real, 1.0)
    controller.release_held()
    assert bench.grip_n == 0.0
