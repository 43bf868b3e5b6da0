"""Cells in real time: the process that the plugin starts, and what becomes of it."""

import subprocess
import sys
import time
from pathlib import Path

import pytest

from cell.config.file import load_config
from gripper.dynamixel.bus import ServoBus
from gripper.dynamixel.control_table import LED, TORQUE_ENABLE
from gripper.dynamixel.serial_port import SerialStream
from pytest_tactile_cell.process import CellProcessError
from tests.pytest_tactile_cell.runs import run

CONTRACT = Path(__file__).parents[1] / "contract"


def gone(pid: int) -> bool:
    return not Path(f"/proc/{pid}").exists()


@pytest.mark.real_time
@pytest.mark.usefixtures("free_machine")
def test_a_process_serves_both_ports_and_takes_faults(cell_process, inject_fault) -> None:
    cell = cell_process(objects={"pin": "cylinder:diameter=6mm,length=20mm"}, seed=3)
    config = load_config(cell.config_path)
    assert (config.gripper.port, config.tactile.channel) == (cell.servo_port, cell.can_channel)
    assert config.positioner.socket == cell.positioner_socket
    assert cell.ask(place="pin")["pose"]["x_m"] == 0.0
    assert cell.grip_n() == 0.0
    with pytest.raises(CellProcessError, match=r"refused.*nothing-known"):
        cell.ask(place="nothing-known")
    with pytest.raises(CellProcessError, match=r"refused.*there is no fault"):
        inject_fault("can.nothing")
    with pytest.raises(TimeoutError, match=r"0\.00 N after 0\.1 s, expected 1 N"):
        cell.wait_for_grip(1.0, timeout_s=0.1)

    stream = SerialStream(cell.servo_port, cell.servo_baud_rate)
    bus = ServoBus(stream, baudrate=cell.servo_baud_rate, clock=time)
    try:
        assert [bus.ping(i).servo_id for i in cell.servo_ids] == [1, 2]
        fault = inject_fault("servo1.off")
        with pytest.raises(TimeoutError):
            bus.ping(1)
        fault.clear()
        fault.clear()
        assert bus.ping(1).servo_id == 1
    finally:
        bus.close()


@pytest.mark.long
def test_processes_end_with_the_test_and_a_dead_one_shows_its_log(pytester) -> None:
    pytester.makepyfile(
        """
        import os, pathlib, signal, time
        import pytest
        from pytest_tactile_cell.process import CellProcessError

        def note(cell, name):
            pathlib.Path(name).write_text(f"{cell.pid} {cell.config_path.parent}")

        def test_killed_on_purpose(cell_process, inject_fault):
            cell = cell_process()
            note(cell, "killed")
            lost = inject_fault("can.loss=0.05")
            before_s = time.monotonic()
            while lost.began_s is None:
                assert time.monotonic() < before_s + 10.0
            assert abs(lost.began_s - before_s) < 10.0
            assert inject_fault("can.duplicate@100s").began_s is None
            cell.kill()
            assert lost.began_s is None
            with pytest.raises(CellProcessError, match="ended with exit code -9"):
                cell.ask(state=True)

        def test_stopped(cell_process):
            cell = cell_process()
            note(cell, "stopped")
            os.kill(cell.pid, signal.SIGSTOP)

        def test_dies(cell_process):
            cell = cell_process()
            note(cell, "dies")
            os.kill(cell.pid, signal.SIGKILL)
            os.waitid(os.P_PID, cell.pid, os.WEXITED | os.WNOWAIT)

        def test_does_not_start(cell_process):
            cell_process(objects={"thing": "blob:size=3mm"})
        """
    )
    result = run(pytester)
    result.assert_outcomes(passed=3, failed=1, errors=1)
    result.stdout.fnmatch_lines_random(
        [
            "*CellProcessError: the simulated cell (process *) ended by itself during the test "
            "with exit code -9; call kill() if the test should end it. Its log:*",
            "*CellProcessError: the simulated cell did not start. It ended with exit code *",
            "*simulator.objects: thing: *blob*",
        ]
    )
    for name in ("killed", "stopped", "dies"):
        pid, folder = (pytester.path / name).read_text().split()
        assert gone(int(pid)), name
        assert not Path(folder).exists(), name


@pytest.mark.slow
def test_a_process_does_not_outlive_a_test_run_that_is_killed(pytester) -> None:
    pytester.makepyfile(
        """
        import os, pathlib, signal

        def test_is_killed(cell_process):
            pathlib.Path("pid").write_text(str(cell_process().pid))
            os.kill(os.getpid(), signal.SIGKILL)
        """
    )
    result = pytester.runpytest_subprocess("-p", "no:cacheprovider")
    assert result.ret == -9
    pid, end_s = int((pytester.path / "pid").read_text()), time.monotonic() + 10.0
    while not gone(pid) and time.monotonic() < end_s:
        time.sleep(0.02)
    assert gone(pid)


@pytest.mark.real_time
@pytest.mark.usefixtures("free_machine")
def test_the_contract_holds_over_real_ports_and_never_touches_a_held_part(cell_process) -> None:
    cell = cell_process()
    ports = (
        *("--servo-port", cell.servo_port),
        *("--can-interface", cell.can_interface, "--can-channel", cell.can_channel),
    )

    def contract(*arguments: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "pytest", "-q", "-k", "hardware", *ports, *arguments]
        return subprocess.run(
            [*command, "-p", "no:cacheprovider", "--no-cov", CONTRACT],
            capture_output=True,
            text=True,
            timeout=100,
            check=False,
        )

    found = contract()
    assert found.returncode == 0, found.stdout
    assert " 26 passed, 9 skipped" in f" {found.stdout.strip().splitlines()[-1]}"
    assert "needs torque: --allow-motion" in found.stdout

    stream = SerialStream(cell.servo_port, cell.servo_baud_rate)
    bus = ServoBus(stream, baudrate=cell.servo_baud_rate, clock=time)
    bus.write(2, TORQUE_ENABLE, 1)
    bus.close()
    found = contract("-k", "hardware and read_back", "--allow-motion")
    assert found.returncode == 1
    assert "servo 2 holds torque, a part may be in the grip: nothing was written" in found.stdout
    stream = SerialStream(cell.servo_port, cell.servo_baud_rate)
    bus = ServoBus(stream, baudrate=cell.servo_baud_rate, clock=time)
    assert (bus.read(2, TORQUE_ENABLE), bus.read(1, LED)) == (1, 0)
    bus.close()
