"""The station's program on the simulated cell, in virtual time."""

import pytest
from sorting_station import Robot, SortingStation

from cell.control.plan import Pose
from cell.errors import PositionerError
from gripper.errors import PartLost, PartSlipped

BINS = {"dowel": "bin A", "bearing": "bin B"}


def test_my_parts_are_carried_into_their_bins(simulated_cell, recognizer):
    robot = Robot()
    held_n = []

    def bring(destination):
        held_n.append(cell.grip_n)
        robot.bring(destination)

    cell = simulated_cell(seed=7, places=bring).start()
    station = SortingStation(cell.controller, recognizer, cell.config.sequence, BINS)
    for part in BINS:
        cell.controller.moves.present(part)
        station.sort(seed=8)
    assert robot.places == list(BINS.values())
    assert min(held_n) > 3.0
    assert cell.grip_n == 0.0


def test_a_part_that_is_lost_on_the_way_stops_my_station(simulated_cell, recognizer):
    cell = simulated_cell(seed=7, places=lambda _destination: cell.simulated.remove()).start()
    station = SortingStation(cell.controller, recognizer, cell.config.sequence, BINS)
    cell.controller.moves.present("dowel")
    with pytest.raises((PartLost, PartSlipped)):
        station.sort(seed=5)
    assert cell.controller.life.status.grasp == "PART LOST"


def test_my_robot_is_asked_for_each_pose(simulated_cell):
    robot = Robot()
    cell = simulated_cell(mover=robot.move).start("dowel")
    record = cell.grasp(force_n=3.0, pose=Pose(x_m=1e-3, rotation_rad=0.5))
    assert robot.poses == [Pose(x_m=1e-3, rotation_rad=0.5)]
    assert record.outcome.final_force_n == pytest.approx(3.0, abs=0.4)


def test_a_pose_that_my_robot_refuses_is_not_grasped(simulated_cell):
    robot = Robot(reach_m=0.001)
    cell = simulated_cell(mover=robot.move).start("dowel")
    with pytest.raises(PositionerError, match="refused"):
        cell.grasp(pose=Pose(x_m=5e-3))
    assert cell.grip_n == 0.0
    assert cell.grasp(pose=Pose()).outcome.final_force_n > 2.0


def test_the_force_stays_below_the_limit_of_my_config(simulated_cell):
    cell = simulated_cell().start("spacer")
    highest_n = 0.0

    def watch(_now_s):
        nonlocal highest_n
        highest_n = max(highest_n, *cell.simulated.world.contact_force_n())

    cell.clock.on_advance.append(watch)
    cell.grasp(force_n=4.0)
    assert 3.5 < highest_n < cell.config.gripper.force_max_n
