"""The plugin as pytest sees it: options, docs, failures, and what it costs others."""

import math
import re
import subprocess
import sys
import time
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import pytest_tactile_cell.bench
import pytest_tactile_cell.process
import pytest_tactile_cell.virtual  # noqa: F401
from cell.config.file import load_config
from cell.control.plan import Pose
from cell.control.states import CellState
from cell.errors import ConfigError, PositionerError
from cell.recording.reader import read_recording
from gripper.dynamixel.bus import ServoBus
from gripper.dynamixel.control_table import LED, TORQUE_ENABLE
from gripper.dynamixel.serial_port import SerialStream
from gripper.errors import BusTimeout
from pytest_tactile_cell.process import CellProcess, CellProcessError
from tactile.errors import FrameTimeout
from tests import blocks
from tests.cell.cells import COARSE_PADS
from tests.hil.program import gone
from tests.marks import LONG

# In-process runs of pytester forget what they import; numpy does not bear being imported twice.


def run(pytester: pytest.Pytester, *arguments: str) -> pytest.RunResult:
    # Each run would import hypothesis anew, which takes longer than the run.
    quick = ("-p", "no:cacheprovider", "-p", "no:xdist", "-p", "no:hypothesispytest")
    return pytester.runpytest_inprocess(*quick, *arguments)


@pytest.mark.slow
@pytest.mark.parametrize("hiding", ["cell", LONG("gripper")])
def test_a_project_with_modules_of_our_names_runs_until_it_wants_a_cell(pytester, hiding) -> None:
    pytester.makepyfile(**dict.fromkeys((hiding, "motion"), "VALUE = 1"))
    pytester.makepyfile(
        f"""
        import motion, {hiding}

        def test_own(): assert motion.VALUE == {hiding}.VALUE == 1
        def test_ours(simulated_cell): pass
        """
    )
    result = pytester.runpytest_subprocess("-p", "no:cacheprovider")
    result.assert_outcomes(passed=1, errors=1)
    where = pytester.path / f"{hiding}.py"
    assert "another exception" not in result.stdout.str()
    result.stdout.fnmatch_lines([f"{where} hides the package '{hiding}' of tactile-cell in *"])
    contract = pytester.runpytest_subprocess("-p", "no:cacheprovider", "--contract", "sensor")
    assert contract.ret == pytest.ExitCode.USAGE_ERROR
    contract.stderr.fnmatch_lines([f"*{where} hides the package '{hiding}' of tactile-cell*"])


@pytest.mark.slow
def test_a_folder_without_this_checkout_runs_its_contracts(pytester) -> None:
    assert pytester.runpytest_subprocess("--contract", "servo_model").ret == 0


def test_fixtures_and_options_say_what_they_are(pytester) -> None:
    fixtures = run(pytester, "--fixtures", "-v").stdout.str()
    ours = re.findall(r"\n(\w+) (?:\[.*\] )?-- .*pytest_tactile_cell.*\n((?: .*\n)*)", fixtures)
    assert {"simulated_cell", "servo_bus", "can_bus", "cell_process"} <= {name for name, _ in ours}
    assert all(len(text.strip()) > 60 for _, text in ours), ours
    options = run(pytester, "--help").stdout.str()
    for name in ("--cell-config", "--servo-port", "--can-interface", "--allow-motion"):
        assert name in options
    assert "cell_config (string):" in options


def test_the_ini_option_names_the_config_and_the_command_line_overrules(pytester) -> None:
    pytester.makeini("[pytest]\ncell_config = cells/a.yaml")
    folder = pytester.mkdir("cells")
    for name in "ab":
        (folder / f"{name}.yaml").write_text(f"name: {name}\ngripper: {{port: simulated}}\n")
    pytester.makepyfile(
        """
        def test_name(cell_config, request):
            print("FOUND", cell_config.name)
        """
    )
    result = run(pytester, "-s")
    result.stdout.fnmatch_lines(["*FOUND a"])
    result = run(pytester, "-s", "--cell-config", "cells/b.yaml")
    result.stdout.fnmatch_lines(["*FOUND b"])


@pytest.mark.parametrize("arguments", [("--can-interface", "slcan"), ("--can-channel", "can0")])
def test_options_that_make_no_sense_are_refused(pytester, arguments) -> None:
    result = run(pytester, *arguments)
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    result.stderr.fnmatch_lines(["*--can-interface and --can-channel need each other*"])


def test_a_wrong_config_is_named_without_a_traceback(pytester) -> None:
    (pytester.path / "cell.yaml").write_text("gripper: {forse_max_n: 9}\n")
    pytester.makepyfile("def test_it(simulated_cell): pass")
    result = run(pytester, "--cell-config", "cell.yaml")
    result.assert_outcomes(errors=1)
    result.stdout.fnmatch_lines(["cell.yaml:1:*gripper.forse_max_n: unknown key*"])
    assert "exception" not in result.stdout.str()


def test_hardware_is_named_in_the_header_and_takes_no_faults(pytester) -> None:
    pytester.makepyfile(
        """
        def test_gone(servo_bus): pass
        def test_nothing_there(can_bus): pass
        def test_fault(can_bus, inject_fault): inject_fault("can.loss=0.5")
        """
    )
    virtual = ("--can-interface", "virtual", "--can-channel", "x")
    result = run(pytester, *virtual, "--servo-port", "/dev/not-there")
    result.assert_outcomes(passed=1, failed=1, errors=1)
    result.stdout.fnmatch_lines(
        [
            "tactile-cell: REAL HARDWARE: servos at /dev/not-there, control unit at virtual x; "
            "servos must not move (no --allow-motion)",
            "*PortLost*/dev/not-there*",
            "fault 'can.loss=0.5' refused: this test runs on hardware (control unit at virtual x)*",
        ]
    )
    assert "REAL HARDWARE" not in run(pytester, "--collect-only").stdout.str()


@pytest.mark.slow
def test_faults_end_with_the_test_whatever_the_order_of_fixtures(pytester) -> None:
    pytester.makepyfile(
        """
        faults = []

        def test_first(inject_fault, simulated_cell):
            simulated_cell()
            faults.append(inject_fault("can.loss=0.5"))
            faults.append(inject_fault("servo1.off@5s"))

        def test_second(cell_bench, inject_fault):
            cell_bench.simulated
            faults.append(inject_fault("servo2.off"))
            assert 0, "fails with a fault in place"

        def test_all_are_over():
            assert len(faults) == 3 and all(fault.over for fault in faults)
        """
    )
    result = run(pytester, "-W", "error")
    result.assert_outcomes(passed=2, failed=1, errors=1)
    result.stdout.fnmatch_lines(["*PytestWarning: fault 'servo1.off@5s' never began*"])


@pytest.mark.slow
def test_what_the_docs_show_works(pytester) -> None:
    page = (Path(__file__).parents[2] / "docs" / "how-to" / "test-your-cell.md").read_text()
    (code,) = blocks("how-to/test-your-cell.md", "python")
    (mark,) = re.findall(r"`(pytest\.mark\.skipif\(.*?\))`", page)
    pytester.makepyfile(f"{code}\n\n@{mark}\ndef test_of_the_simulator(): pass\n")
    run(pytester).assert_outcomes(passed=2)
    result = run(pytester, "--servo-port", "/dev/not-there", "-k", "of_the_simulator")
    result.assert_outcomes(skipped=1, deselected=1)


# -- The fixtures in virtual time, used as a downstream project uses them --------------------------


PIN = {"pin": "cylinder:diameter=6mm,length=20mm"}
QUICK = {
    "tactile.tare_frames": 25,
    "tactile.layout": COARSE_PADS,
    "gripper.approach_speed_mm_s": 20.0,
}
REAL = """
gripper: {port: /dev/ttyUSB7, servos: [{id: 11}, {id: 12}], force_max_n: 9.0}
tactile: {interface: socketcan, channel: can7, node_id: 9}
positioner: {kind: operator}
"""


@pytest.mark.slow
def test_a_cell_grasps_an_object_of_the_test_at_its_pose_and_records_it(
    simulated_cell, tmp_path
) -> None:
    moved: list[Pose] = []
    cell = simulated_cell(objects=PIN, mover=moved.append, changes=QUICK, folder=tmp_path)
    assert cell.controller.life.state.value == "STOPPED"
    record = cell.start("pin").grasp(force_n=3.0, pose=Pose(x_m=1e-3))
    assert record.outcome.final_force_n == pytest.approx(3.0, abs=0.5)
    assert moved == [Pose(x_m=1e-3)]
    assert cell.grip_n == 0.0
    assert cell.aperture_m > 0.015
    cell.cell.close()
    assert len(read_recording(cell.cell.recording_path).grasps) == 1


@pytest.mark.slow
def test_the_seed_decides_what_is_measured(simulated_cell) -> None:
    def counts(seed: int) -> Any:
        return simulated_cell(objects=PIN, seed=seed, changes=QUICK).start("pin").grasp().grasp

    one, same, other = counts(1), counts(1), counts(2)
    assert np.array_equal(one.counts, same.counts)
    assert not np.array_equal(one.counts[0], other.counts[0])


def test_a_config_of_a_real_cell_is_simulated_with_its_own_ids_and_limits(
    simulated_cell, tmp_path
) -> None:
    path = tmp_path / "cell.yaml"
    path.write_text(REAL)
    cell = simulated_cell(path, changes=QUICK)
    assert cell.config.simulated
    assert (cell.config.gripper.force_max_n, cell.config.positioner.kind) == (9.0, "simulated")
    assert [servo.servo_id for servo in cell.simulated.settings.servos] == [11, 12]
    assert cell.start().cell.controller.hand.statistics.source.frames.complete > 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"changes": {"tactile.tare_framse": 25}}, "did you mean tare_frames"),
        ({"changes": {"gripper.port": "/dev/null"}}, "cannot set gripper.port: the fix"),
        ({"changes": {"positioner.kind": "axes"}}, "cannot set positioner.kind"),
        ({"changes": {"tactile.tare_frames.n": 25}}, "no value 'tactile.tare_frames.n'"),
        ({"changes": {"tactile.tare_frames": 1}}, "tactile.tare_frames"),
        ({"objects": {"thing": "blob"}}, "thing"),
    ],
)
def test_settings_that_cannot_be_are_refused(simulated_cell, arguments, message) -> None:
    with pytest.raises(ConfigError, match=message):
        simulated_cell(**arguments)


def test_time_passes_only_while_somebody_waits(simulated_cell) -> None:
    cell = simulated_cell(objects=PIN, changes=QUICK).start("pin")
    before_s, frames = (
        cell.clock.monotonic(),
        cell.cell.controller.hand.statistics.source.frames.complete,
    )
    cell.idle(0.5)
    assert cell.clock.monotonic() - before_s == pytest.approx(0.5, abs=0.02)
    assert cell.cell.controller.hand.statistics.source.frames.complete - frames >= 20
    cell.sleep(0.05)
    assert cell.clock.monotonic() - before_s == pytest.approx(0.55, abs=0.02)


def test_both_links_have_the_same_devices_behind_them(
    servo_bus, servo_clock, can_bus, can_clock, cell_bench
) -> None:
    assert servo_clock is can_clock is cell_bench.simulated.clock
    assert servo_bus.ping(1).model_number == 1020
    boot_up = can_bus.recv(1.0)
    assert (boot_up.arbitration_id, bytes(boot_up.data)) == (0x705, b"\0")
    assert can_clock.monotonic() == pytest.approx(boot_up.timestamp)


def test_bytes_and_transactions_share_the_line(servo_bus, servo_stream) -> None:
    servo_stream.write(b"\xff\xff\xfd\x00\x01\x03\x00\x01\x19\x4e")  # a ping, from the manual
    assert servo_stream.read(64, 0.05)[:5] == b"\xff\xff\xfd\x00\x01"
    assert servo_bus.statistics.transactions == 0


def test_a_fault_acts_until_it_is_cleared(servo_bus, inject_fault) -> None:
    fault = inject_fault("servo1.off")
    with pytest.raises(BusTimeout):
        servo_bus.ping(1)
    assert fault.began_s is not None
    fault.clear()
    assert servo_bus.ping(1).servo_id == 1


def test_the_cell_is_named_where_a_test_has_several(simulated_cell, inject_fault) -> None:
    with pytest.raises(pytest.fail.Exception, match="0 simulated cells so far; make one first"):
        inject_fault("can.loss=0.5")
    one, two = simulated_cell(), simulated_cell()
    with pytest.raises(pytest.fail.Exception, match="2 simulated cells; name one"):
        inject_fault("servos.unplugged")
    inject_fault("servos.unplugged", into=two)
    assert not one.simulated.injector.faults
    assert two.simulated.injector.faults
    with pytest.raises(pytest.fail.Exception, match="not a simulated cell of this test"):
        inject_fault("servos.unplugged", into=one.simulated)


@pytest.mark.parametrize("label", ["washer", "cylinder:diameter=6"])
def test_an_object_that_nobody_has_is_refused_at_once(simulated_cell, label) -> None:
    cell = simulated_cell(objects=PIN, changes=QUICK).start()
    expected = "'washer'; there are pin" if label == "washer" else "is not NAME=LENGTH with a unit"
    with pytest.raises(PositionerError, match=expected):
        cell.controller.moves.present(label)
    assert cell.controller.life.state is CellState.IDLE
    with pytest.raises(PositionerError, match=expected):
        simulated_cell(objects=PIN, changes=QUICK).start(label)


@pytest.mark.slow
def test_the_runtime_of_a_host_program_shows_the_true_force_and_takes_faults(
    cell_runtime, inject_fault
) -> None:
    moved: list[Pose] = []
    cell = cell_runtime(objects=PIN, changes=QUICK, mover=moved.append)
    assert cell.run({"task": "grip", "force_n": 3.0, "present": "pin"}).held
    assert (len(moved), cell.grip_n() > 2.0) == (1, True)
    cell.release()
    inject_fault("can.lose_next=1", into=cell).clear()  # it is over at once

    lost = inject_fault("can.loss=1@contact+0.1s", into=cell)
    assert lost.began_s is None
    with pytest.raises(FrameTimeout):
        cell.run({"task": "grip", "force_n": 3.0})
    assert math.isfinite(lost.began_s)
    cell.close()
    assert math.isnan(lost.began_s)


# -- Cells in real time: the process that the plugin starts, and what becomes of it ----------------


CONTRACT = Path(__file__).parents[1] / "contract"


def servos_of(cell: CellProcess) -> closing[ServoBus]:
    """Return the servo bus of a process, as another program opens it."""
    stream = SerialStream(cell.servo_port, cell.servo_baud_rate)
    return closing(ServoBus(stream, baudrate=cell.servo_baud_rate, clock=time))


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

    with servos_of(cell) as bus:
        assert [bus.ping(i).servo_id for i in cell.servo_ids] == [1, 2]
        fault = inject_fault("servo1.off")
        with pytest.raises(TimeoutError):
            bus.ping(1)
        fault.clear()
        fault.clear()
        assert bus.ping(1).servo_id == 1


@pytest.mark.long
def test_processes_end_with_the_test_and_a_dead_one_shows_its_log(pytester) -> None:
    pytester.makepyfile(
        """
        import math, os, pathlib, signal, time
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
            assert math.isnan(lost.began_s)
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
    assert pytester.runpytest_subprocess("-p", "no:cacheprovider").ret == -9
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

    result = contract()
    assert result.returncode == 0, result.stdout
    last = result.stdout.strip().splitlines()[-1]
    count = {word: int(number) for number, word in re.findall(r"(\d+) (\w+)", last)}
    # The rows that -k leaves out are the same tests on the simulator.
    assert count["passed"] + count["skipped"] == count["deselected"], last
    assert count["passed"] >= 20, last
    assert "needs torque: --allow-motion" in result.stdout

    with servos_of(cell) as bus:
        bus.write(2, TORQUE_ENABLE, 1)
    result = contract("-k", "hardware and read_back", "--allow-motion")
    assert result.returncode == 1
    assert "servo 2 holds torque, a part may be in the grip: nothing was written" in result.stdout
    with servos_of(cell) as bus:
        assert (bus.read(2, TORQUE_ENABLE), bus.read(1, LED)) == (1, 0)
