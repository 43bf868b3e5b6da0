"""Faults of the axes that carry the part: the motion stops, the grip is not touched."""

from dataclasses import replace
from functools import partial
from typing import Any

from cell.control.plan import GraspStep, Pose
from motion.object_dictionary import State
from simulator.can.drive import SimulatedDrive
from tests.cell.conftest import once
from tests.faults.campaign import FaultRow, Observed, campaign_cell, observe, recovered

X_AXIS = {
    "kind": "cia402", "moves": "x", "node_id": 11, "increments": 1000.0, "low": -6.0,
    "high": 6.0, "homing": "negative_switch", "home": -7.0, "homing_velocity": 20.0,
}  # fmt: skip
ROTATION_AXIS = {
    "kind": "cia402", "moves": "rotation", "node_id": 12, "increments": 100.0, "low": -10.0,
    "high": 100.0, "homing": "here", "home": 0.0, "velocity": 45.0,
}  # fmt: skip
WRIST = {"kind": "dynamixel", "moves": "roll", "zero_pulse": 1024, "low": -10.0, "high": 100.0}
CHANGES: dict[str, Any] = {
    "positioner": {"kind": "axes", "axes": [X_AXIS, ROTATION_AXIS, WRIST]},
    "sequence.y_mm": [0.0, 0.0],
    "sequence.rotation_deg": [0.0, 90.0],
    "sequence.roll_deg": [0.0, 90.0],
}
"""A cell with axis 1, a drive along x, axis 2, a drive that turns, and axis 3, a wrist."""
STOPPED_S = 0.6
"""So long after the fault all axes that can be stopped have to stand."""
STEP = GraspStep(pose=Pose(x_m=2e-3, rotation_rad=0.5, roll_rad=0.5), force_n=3.0)


def axis_fails(row: FaultRow) -> Observed:
    """Inject while the axes move to the second pose; then take the steps of the fault.

    It is detected when another drive than that of the axis that fails is in its quick stop.
    """
    with campaign_cell(CHANGES | dict(row.changes)) as cell:
        cell.start()
        cell.grasp()
        axes = cell.simulated.devices.axes
        drives = [axis for axis in axes.values() if isinstance(axis, SimulatedDrive)]
        failing = list(axes.values())[int(row.injected[len("axis")]) - 1]
        began_s = once(
            cell.clock,
            lambda: all(axis.moving for axis in axes.values()),
            lambda: cell.simulated.inject(row.injected),
        )

        def stopped() -> bool:
            others = [drive for drive in drives if drive is not failing]
            return any(drive.state is State.QUICK_STOP_ACTIVE for drive in others)

        with cell.first_time(stopped) as known_s:
            observed = observe(cell, job=lambda one: one.controller.grasp(STEP))
        cell.simulated.clock.sleep(STOPPED_S)
        silent = [drive for drive in drives if drive.dead]
        if any(axis.moving for axis in axes.values() if axis not in silent):
            return replace(observed, reaction="MOVES")
        cell.simulated.injector.clear_all()
        seen = replace(observed, detected_after_s=known_s[0] - began_s[0])
        return recovered(cell, row, seen, partial(cell.controller.grasp, STEP))


def drive_fails_in_a_hold(row: FaultRow) -> Observed:
    """Inject while the part is held: the grip is kept, and the next motion refuses."""
    with campaign_cell(CHANGES | dict(row.changes)) as cell:
        observed = observe(cell, row.injected)
        if observed.reaction != "NOTHING":
            return observed
        refused = observe(cell, job=lambda one: one.controller.grasp(STEP))
        return recovered(cell, row, refused, partial(cell.controller.grasp, STEP))
