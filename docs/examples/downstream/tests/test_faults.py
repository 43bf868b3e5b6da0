"""What the station's cell does when something breaks: each fault by name, at its moment."""

import pytest

from cell.control.states import CellState
from cell.errors import CellStateError
from gripper.errors import PortLost
from simulator.errors import SimulatorSettingsError
from tactile.errors import FrameTimeout


def still_held(cell):
    """Say whether the part is in the grip now, and two seconds later too."""
    before_n = cell.grip_n
    cell.sleep(2.0)
    return min(before_n, cell.grip_n) > 0.5


def test_lost_frames_hold_the_part_until_a_person_has_acted(station_cell, inject_fault):
    controller = station_cell.controller
    controller.moves.present("dowel")
    lost = inject_fault("can.loss=1@contact+0.1s")
    with pytest.raises(FrameTimeout):
        station_cell.grasp(force_n=3.0)
    assert station_cell.clock.monotonic() - lost.began_s < 0.15
    assert controller.life.state is CellState.ABORTED
    assert "no force message" in controller.life.fault
    assert still_held(station_cell)

    lost.clear()  # the cable is mended; the cell does not go on by itself
    with pytest.raises(CellStateError):
        station_cell.grasp()
    controller.life.clear()
    assert still_held(station_cell)
    controller.release_held()
    assert station_cell.grip_n == 0.0
    controller.life.reset()
    station_cell.start("dowel").grasp(force_n=3.0)


def test_a_cable_out_in_mid_grasp_keeps_the_grip(station_cell, inject_fault):
    station_cell.controller.moves.present("dowel")
    inject_fault("servos.unplugged@contact+0.1s")
    with pytest.raises(PortLost):
        station_cell.grasp(force_n=3.0)
    assert station_cell.controller.life.state is CellState.ABORTED
    assert station_cell.controller.life.holding
    assert still_held(station_cell)


@pytest.mark.parametrize("fault", ["can.duplicate=0.1", "servos.loss=0.02", "servos.corrupt=0.02"])
def test_a_poor_cable_is_no_reason_to_stop(station_cell, inject_fault, fault):
    inject_fault(fault)
    station_cell.controller.moves.present("dowel")
    record = station_cell.grasp(force_n=3.0)
    assert record.outcome.final_force_n == pytest.approx(3.0, abs=0.4)
    counts = station_cell.cell.health()
    noticed = counts["tactile"]["duplicate"] + counts["servo_bus"]["retries"]
    assert noticed > 0, "the fault did nothing"


def test_a_misspelt_fault_does_not_pass_for_a_good_cell(station_cell, inject_fault):
    with pytest.raises(SimulatorSettingsError, match="there is no fault"):
        inject_fault("can.lost=0.05")
