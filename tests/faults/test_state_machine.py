"""Random commands and faults: after each step all invariants hold."""

import re
import traceback
from collections.abc import Iterator
from typing import Any

import pytest
from hypothesis import given, settings

from cell.control.lifecycle import CellLifecycle
from gripper.dynamixel.control_table import REGISTERS
from gripper.force.loop import Action
from gripper.force.supervision.empty_grip import EmptyGrip
from gripper.force.supervision.part_watch import PartWatch
from gripper.gripper import Gripper
from gripper.servos.group import Servos
from gripper.values.state import GripperPhase
from simulator.faults.injector import check_fault
from tests.cell.conftest import once
from tests.faults import state_machine
from tests.faults.invariants import InvariantBroken
from tests.faults.state_machine import PIECES, STEPS, Driver, fault_texts, run_machine
from tests.fuzz.harness import seed_of_run
from tests.marks import LONG

WALKS = [(seed, 50) for seed in (1, 2, 3, 4)]
"""Seed and steps of the walks of each change."""
CAN_OFF = "can.off@contact+100ms"
LONG_WALKS = [LONG(seed, STEPS) for seed in range(1, PIECES + 1)]


@pytest.mark.slow
@pytest.mark.no_cover  # to count lines takes as long again as to run them
@pytest.mark.parametrize(("seed", "steps"), [*WALKS, *LONG_WALKS])
def test_whatever_is_asked_and_whatever_fails_all_invariants_hold(seed: int, steps: int) -> None:
    assert run_machine(steps, seed_of_run(seed)) >= steps


@pytest.mark.slow
@given(fault_texts())
@settings(max_examples=200)
def test_the_machine_draws_faults_that_there_are(text: str) -> None:
    check_fault(text)


# What the machine is for: each of these defects, put in on purpose, is found.


def drive(*, fault: str = CAN_OFF) -> None:
    """Fail in a grasp, clear it, and go on."""
    cell = Driver(self_test=False)
    try:
        cell.do("start")
        cell.inject(fault)
        cell.grasp(0.0, 3.0, 0.0)
        cell.wait(0.1)
        cell.recover()
        cell.identify(3.0)
    finally:
        cell.close()


@pytest.mark.slow
def test_nothing_is_broken_as_it_is() -> None:
    drive()


WRITTEN = {
    (Gripper, "keep_grip"): (
        *("torque_enable", 0, CAN_OFF),
        "torque of servo 1 off with a part in the grip",
    ),
    (Gripper, "clear_fault"): (
        *("torque_enable", 1, "servo1.overload@contact+50ms"),
        "torque of servo . on while CLEARING, without a reset",
    ),
    (CellLifecycle, "tick"): (
        *("goal_current", 200, CAN_OFF),
        r"goal currents from .* to \[200, .* while ABORTED",
    ),
}
"""What a method writes to the servos after its work, the fault before it, and what is found."""


@pytest.mark.parametrize(("owner", "method"), WRITTEN)
def test_a_grip_that_a_fault_opens_and_torque_that_comes_by_itself_are_found(
    monkeypatch: pytest.MonkeyPatch, owner: type, method: str
) -> None:
    register, value, fault, complaint = WRITTEN[owner, method]
    plain = getattr(owner, method)

    def spoilt(it: Any, **options: Any) -> None:
        plain(it, **options)
        if isinstance(it, Gripper) or it.fault is not None:
            gripper = it if isinstance(it, Gripper) else it.hand.gripper
            for servo in gripper.settings.servos:
                gripper.bus.write(servo.servo_id, REGISTERS[register], value)

    monkeypatch.setattr(owner, method, spoilt)
    with pytest.raises(InvariantBroken, match=complaint):
        drive(fault=fault)


@pytest.mark.slow
def test_a_part_that_the_cell_lets_go_by_itself_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    fault = "unit.force_gain=0@contact+80ms"
    drive(fault=fault)
    monkeypatch.setattr(PartWatch, "_confirmed", lambda *_: True)
    monkeypatch.setattr(EmptyGrip, "step", lambda *_: Action(done=True))
    with pytest.raises(InvariantBroken, match=r"open by themselves on a part .* [123]\.\d"):
        drive(fault=fault)


@pytest.mark.slow
def test_fingers_that_a_cancel_does_not_stop_are_found(monkeypatch: pytest.MonkeyPatch) -> None:
    def letting_go() -> None:
        cell = Driver(self_test=False)
        cell.do("start")

        def fast() -> bool:
            wide = cell.simulated.devices.mechanics.aperture_m > 0.008
            return cell.controller.hand.phase is GripperPhase.RELEASING and wide

        once(cell.simulated.clock, fast, cell.controller.life.cancel)
        try:
            cell.grasp(0.0, 3.0, 0.0)
            cell.wait(0.2)
        finally:
            cell.close()

    letting_go()
    monkeypatch.setattr(Servos, "stop_motion", lambda _servos: [])
    with pytest.raises(InvariantBroken, match=r"the fingers went on from .* after their stop"):
        letting_go()


@pytest.fixture
def cell() -> Iterator[Driver]:
    """A driver that was started; what it has found broken counts no more at its end."""
    made = Driver(self_test=False)
    made.do("start")
    yield made
    made.monitor.broken.clear()
    made.close()


def test_a_label_from_spoiled_taxels_is_found(cell, monkeypatch) -> None:
    monkeypatch.setattr(state_machine, "spoiling", lambda _faults, _now_s: ["taxels.off=0.9"])
    with pytest.raises(InvariantBroken, match=r"a label in spite of taxels.off=0.9"):
        cell.identify(3.0)


@pytest.mark.slow
def test_a_force_above_the_cap_is_found(cell: Driver) -> None:
    cell.grasp(0.0, 3.0, 0.0)
    cell.monitor._force_max_n = 2.0
    with pytest.raises(InvariantBroken, match="the cap is 2 N"):
        cell.grasp(0.0, 3.0, 0.0)


@pytest.mark.slow
def test_frames_that_nobody_scanned_are_found(cell: Driver) -> None:
    cell._watch_scans = lambda _now_s: None  # type: ignore[method-assign]
    cell._scanned.clear()
    cell.simulated.clock.on_advance.pop()
    with pytest.raises(InvariantBroken, match="never scanned"):
        cell.identify(3.0)


@pytest.mark.slow
def test_an_error_without_a_type_and_a_command_without_an_end_are_found(cell: Driver) -> None:
    def fail() -> None:
        raise KeyError("nobody expects it")

    def hang() -> None:
        while True:
            cell.simulated.clock.sleep(0.1)

    for call, complaint in ((fail, "ended with KeyError"), (hang, "did not end within its time")):
        with pytest.raises(InvariantBroken, match=complaint):
            cell.command("x", call)


@pytest.mark.slow
def test_a_defect_is_reported_with_its_seed_and_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Driver, "wait", lambda self, _s: self.monitor.broken.append("so"))
    # What does not happen a second time is in a group.
    with pytest.raises((InvariantBroken, ExceptionGroup)) as found:
        run_machine(400, 1)
    assert found.value.__notes__[-1] == "seed 1"
    shown = "".join(traceback.format_exception(found.value))
    assert "InvariantBroken: so" in shown
    assert re.search(r"\n[ |]*after\n", shown)
