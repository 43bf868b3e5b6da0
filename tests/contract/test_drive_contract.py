"""What a CiA 402 drive does on its bus, simulated or real, as far as the axes rely on it."""

from typing import Any

import pytest

from motion import object_dictionary as od
from motion.errors import AxisMissing, AxisNotOperational
from motion.object_dictionary import Control, ModeOfOperation, State

READY = (State.SWITCH_ON_DISABLED, State.READY_TO_SWITCH_ON)


@pytest.fixture
def moving_drive(drive: Any) -> Any:
    if not drive.may_move:
        pytest.skip("needs motion: --allow-motion")
    return drive


def test_it_is_a_drive_with_the_modes_that_are_needed(drive: Any) -> None:
    assert drive.device._read(od.DEVICE_TYPE) & 0xFFFF == 402
    modes = drive.device._read(od.SUPPORTED_MODES)
    assert modes >> (ModeOfOperation.PROFILE_POSITION - 1) & 1
    assert State.of(drive.device._status()).words in drive.device.identify()


def test_its_heartbeat_comes_as_often_as_it_shall(drive: Any) -> None:
    drive.device._write(od.HEARTBEAT_MS, 0, 50)
    beats = drive.heard(od.COB_HEARTBEAT + drive.node_id, 1.0)
    assert 15 <= len(beats) <= 25
    assert all(len(data) == 1 and data[0] & 0x7F in (4, 5, 127) for _, data in beats)


def test_a_stopped_drive_beats_on_and_answers_no_sdo(drive: Any) -> None:
    drive.device._write(od.HEARTBEAT_MS, 0, 50)
    drive.device._command("STOPPED")
    with pytest.raises(AxisNotOperational, match="NMT state stopped"):
        drive.device.identify()
    drive.device.clear_fault(reboot=False)
    beats = drive.heard(od.COB_HEARTBEAT + drive.node_id, 0.5)
    assert {data[0] & 0x7F for _, data in beats[1:]} == {5}


def test_what_is_set_up_is_read_back(drive: Any) -> None:
    drive.device._set_up()
    wanted = drive.device._settings
    assert drive.device._read(od.SOFTWARE_LIMITS, 1) == wanted.low
    assert drive.device._read(od.PROFILE_VELOCITY) == wanted.velocity
    assert drive.device._read(od.QUICK_STOP_OPTION) == od.STAY_IN_QUICK_STOP


def test_an_object_that_is_not_there_is_refused_with_its_name(drive: Any) -> None:
    with pytest.raises(AxisMissing, match=r"refused to read 1018h:9"):
        drive.device._transfer("read", 0x1018, 9, drive.device._client.upload)


def test_without_power_stage_it_goes_between_two_states(drive: Any) -> None:
    device = drive.device
    device._write(od.CONTROLWORD, 0, Control.DISABLE_VOLTAGE)
    for control, state in zip(
        (Control.SHUTDOWN, Control.DISABLE_VOLTAGE), READY[::-1], strict=True
    ):
        device._write(od.CONTROLWORD, 0, control)
        device._until(lambda state=state: device._state() is state, 2.0, "does not follow")
        assert device._read(od.VELOCITY) == 0


@pytest.mark.slow
def test_it_goes_to_both_ends_and_stops_quickly_on_the_way(moving_drive: Any) -> None:
    drive = moving_drive
    near = abs(drive.device._settings.window / drive.axes._axes[drive.name].increments)
    middle, way = 0.5 * (drive.low + drive.high), 0.4 * (drive.high - drive.low)
    for target in (middle - way, middle + way):
        reached = drive.axes.move({drive.name: target})[drive.name]
        assert reached == pytest.approx(target, abs=near)

    axis = drive.axes._axes[drive.name]
    half_s = way / axis.velocity
    began_s = drive.clock.monotonic()

    def stop() -> None:
        if drive.clock.monotonic() - began_s > half_s:
            raise InterruptedError

    with pytest.raises(InterruptedError):
        drive.axes.move({drive.name: middle - way}, stop)
    assert drive.device._state() is State.QUICK_STOP_ACTIVE
    assert middle - way + near < axis.position < middle + way
