"""The plugin as pytest sees it: options, docs, failures, and what it costs others."""

import re
from importlib.metadata import entry_points
from pathlib import Path

import pytest

from tests.marks import LONG
from tests.pytest_tactile_cell.runs import run

FIXTURES = (
    "cell_config",
    "simulated_cell",
    "servo_bus",
    "servo_stream",
    "servo_clock",
    "can_bus",
    "can_clock",
    "cell_process",
    "cell_runtime",
    "inject_fault",
)


def test_pytest_finds_the_plugin() -> None:
    (entry,) = entry_points(group="pytest11", name="tactile-cell")
    assert entry.value == "pytest_tactile_cell"


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


def test_fixtures_and_options_say_what_they_are(pytester) -> None:
    fixtures = run(pytester, "--fixtures", "-v").stdout.str()
    for name in FIXTURES:
        _, _, text = fixtures.partition(f"\n{name} -- ")
        assert len(text.split("\n\n")[0].split("\n", 1)[1].strip()) > 60, name
    options = run(pytester, "--help").stdout.str()
    for name in ("--cell-config", "--servo-port", "--can-interface", "--allow-motion"):
        assert name in options
    assert "cell_config (string):" in options


def test_the_ini_option_names_the_config_and_the_command_line_overrules(pytester) -> None:
    pytester.makeini("[pytest]\ncell_config = cells/a.yaml")
    folder = pytester.mkdir("cells")
    for name in "ab":
        (folder / f"{name}.yaml").write_text(f"name: {name}\n")
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


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--can-interface", "slcan"), "*--can-interface and --can-channel need each other*"),
        (("--can-channel", "can0"), "*--can-interface and --can-channel need each other*"),
    ],
)
def test_options_that_make_no_sense_are_refused(pytester, arguments, message) -> None:
    result = run(pytester, *arguments)
    assert result.ret == pytest.ExitCode.USAGE_ERROR
    result.stderr.fnmatch_lines([message])


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
    run(pytester).assert_outcomes(passed=2, failed=1)


@pytest.mark.slow
def test_what_the_docs_show_works(pytester) -> None:
    page = (Path(__file__).parents[2] / "docs" / "how-to" / "test-your-cell.md").read_text()
    (code,) = re.findall(r"```python\n(.*?)```", page, flags=re.DOTALL)
    (mark,) = re.findall(r"`(pytest\.mark\.skipif\(.*?\))`", page)
    pytester.makepyfile(f"{code}\n\n@{mark}\ndef test_of_the_simulator(): pass\n")
    run(pytester).assert_outcomes(passed=2)
    result = run(pytester, "--servo-port", "/dev/not-there", "-k", "of_the_simulator")
    result.assert_outcomes(skipped=1, deselected=1)
