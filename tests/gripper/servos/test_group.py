"""The servo group: stop goals, and old goals that never act again after a trip of the watchdog."""

from itertools import chain, repeat
from unittest.mock import DEFAULT, Mock

import pytest

from gripper.errors import BusTimeout, GripperStateError, ServoFault
from gripper.force.ramp import ForceRamp
from gripper.servos.bus_loss import BusLossMonitor
from gripper.servos.goal_limits import ServoGoal
from gripper.servos.group import frozen
from gripper.settings import GripperSettings
from gripper.values.state import GripperPhase
from tests.values import make_servo, make_state


@pytest.fixture
def tripped(make_cell):
    """A part gripped with 14 N, whose servos' watchdogs have tripped: they hold it with less."""
    cell = make_cell(width_m=0.016, aperture_m=0.024, force_max_n=15.0, aperture_open_m=0.024)
    cell.hold_part(ForceRamp.linear(13.6, rate_n_s=20.0, hold_s=0.3))
    cell.clock.sleep(1.0)
    assert [cell.register(index, "bus_watchdog") for index in (0, 1)] == [-1, -1]
    assert 0.5 < cell.force_n < 10.0
    cell.peak_n = cell.force_n
    return cell


def let_time_pass(cell) -> None:
    """Half a second in steps: the mechanics follow."""
    for _ in range(100):
        cell.clock.sleep(0.005)


def test_old_goals_do_not_act_where_the_new_ones_are_lost(tripped, monkeypatch) -> None:
    """One write of another goal register had brought 22 N back at a cap of 15 N."""
    held_n = tripped.force_n
    with monkeypatch.context() as deaf:
        deaf.setattr(tripped.bus, "sync_write", lambda *_: None)
        with pytest.raises(ServoFault, match=r"did not take its goal_position: wrote \d+, read"):
            tripped.gripper.release()
        let_time_pass(tripped)
    assert tripped.peak_n < held_n + 0.1
    assert all(tripped.drives.of(servo).measured for servo in tripped.settings.servos)
    tripped.gripper.clear_fault()
    assert not any(tripped.drives.of(servo).measured for servo in tripped.settings.servos)
    tripped.gripper.release()
    assert tripped.mechanics.aperture_m == pytest.approx(0.024, abs=8e-4)
    assert tripped.peak_n < held_n + 0.1


def test_goals_that_were_lost_once_are_written_again(tripped, monkeypatch) -> None:
    writes = Mock(wraps=tripped.bus.sync_write, side_effect=chain([None], repeat(DEFAULT)))
    monkeypatch.setattr(tripped.bus, "sync_write", writes)
    tripped.gripper.release()
    assert writes.called
    assert tripped.gripper.phase is GripperPhase.IDLE
    assert tripped.mechanics.aperture_m == pytest.approx(0.024, abs=8e-4)


def test_an_answer_lost_between_two_commands_is_asked_for_again(cell, monkeypatch) -> None:
    read = Mock(wraps=cell.bus.sync_read, side_effect=chain([BusTimeout("lost")], repeat(DEFAULT)))
    monkeypatch.setattr(cell.bus, "sync_read", read)
    assert cell.gripper._servos.read_patiently().aperture_m == pytest.approx(
        cell.mechanics.aperture_m, abs=1e-3
    )
    assert read.call_count == 2


def test_a_goal_current_that_was_not_taken_is_found(tripped, monkeypatch) -> None:
    sync_read = tripped.bus.sync_read

    def another_current(ids, block):
        raws = sync_read(ids, block)
        if "goal_current" in raws[2]:
            raws[2]["goal_current"] += 1
        return raws

    monkeypatch.setattr(tripped.bus, "sync_read", another_current)
    with pytest.raises(ServoFault, match="servo 2: it did not take its goal_current"):
        tripped.gripper.release()


def test_a_trip_is_not_cleared_by_what_arms_or_disarms(tripped) -> None:
    """Cleared, the next step of the loop would drive the force up from there at once."""
    held_n = tripped.force_n
    tripped.gripper.keep_grip()
    with pytest.raises(ServoFault, match="watchdog has tripped while a part was held"):
        tripped.gripper.hold(0.5)
    let_time_pass(tripped)
    assert tripped.peak_n < held_n + 0.1


def test_a_silent_servo_does_not_keep_the_other_watchdog_armed(cell) -> None:
    cell.hold_part(ForceRamp.linear(6.0, rate_n_s=20.0, hold_s=0.3))
    cell.device.faults.silent = {1}
    with pytest.raises(BusTimeout):
        cell.gripper.keep_grip()
    assert cell.servos[1].registers.get("bus_watchdog") == 0


def test_the_part_of_another_program_is_not_let_go_without_a_start(cell) -> None:
    cell.hold_part(ForceRamp.linear(6.0, rate_n_s=20.0, hold_s=0.3))
    cell.gripper.keep_grip()
    with pytest.raises(GripperStateError, match="torque from before this program"):
        cell.new_gripper().open()
    assert cell.force_n > 5.0


def goals(angle_rad: float, current_a: float) -> list[ServoGoal]:
    return [ServoGoal(angle_rad=angle_rad, current_a=current_a)]


@pytest.mark.parametrize(("last_rad", "held_rad"), [(0.40, 0.40), (0.60, 0.50)])
def test_a_frozen_finger_never_opens(last_rad: float, held_rad: float) -> None:
    state = make_state(servos=(make_servo(angle_rad=0.5),))
    assert frozen(goals(last_rad, 0.3), state) == goals(held_rad, 0.3)


def test_a_push_does_not_stay_on_a_frozen_finger() -> None:
    state = make_state(servos=(make_servo(angle_rad=0.5),))
    (rest,) = goals(0.40, 0.2)
    for pushes in goals(0.40, 0.6) + goals(0.60, 0.1):
        assert frozen([pushes._replace(rest=rest)], state) == [rest]


def test_periods_of_a_lost_bus_do_not_count_once_it_is_mended() -> None:
    servos = Mock(settings=GripperSettings())
    servos.silent_and_living.return_value = (), ()
    monitor = BusLossMonitor(servos)
    with pytest.raises(BusTimeout, match="the servo bus was lost for"):
        [monitor.missed(BusTimeout("no answer"), 0.0, 0.005 * i) for i in range(1000)]
    monitor.answered()
    monitor.missed(BusTimeout("no answer"), 9.0, 9.0)
