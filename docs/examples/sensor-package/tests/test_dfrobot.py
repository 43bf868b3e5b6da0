"""The device's own bytes, and whole grasps; for all else `pytest --contract sensor:dfrobot`."""

import pytest
from tactile_dfrobot.sensor import LAYOUT, with_crc

from tactile.errors import LinkFault

CONFIG = {
    "tactile.sensor": {"kind": "dfrobot"},
    "tactile.layout": LAYOUT,
    "tactile.calibration": {
        "counts": [256.0, 512.0, 1024.0, 1536.0, 2500.0],
        "force_n": [0.049, 0.124, 0.31, 0.571, 1.6],
    },
    "tactile.tare_frames": 25,
    "gripper.force_stale_ms": 60.0,
}


def test_a_request_has_the_bytes_of_the_data_sheet():
    assert with_crc(bytes.fromhex("010400070024")).hex(" ") == "01 04 00 07 00 24 41 d0"


def test_a_cell_grasps_with_the_sensors(simulated_cell):
    cell = simulated_cell(objects={"pin": "cylinder:diameter=6mm,length=20mm"}, changes=CONFIG)
    record = cell.start("pin").grasp(force_n=3.0)
    assert record.outcome.final_force_n == pytest.approx(3.0, abs=0.5)


def test_a_cable_that_is_out_keeps_the_grip(simulated_cell, inject_fault):
    cell = simulated_cell(objects={"pin": "cylinder:diameter=6mm,length=20mm"}, changes=CONFIG)
    cell.start("pin")
    inject_fault("board.unplugged=0@contact+0.3s")
    with pytest.raises(LinkFault, match="line of DFRobot SEN0704 is gone"):
        cell.grasp(force_n=3.0)
    cell.sleep(2.0)
    assert cell.grip_n > 0.5
