"""The faces of the packages, and the examples of the Python reference as they stand there."""

import ast
import re
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

from tests import blocks
from tests.marks import LONG

EXAMPLES = blocks("reference/python-api.md", "python")
PRINTED = (
    r"force_reached (4\.[6-9]|5\.[0-4]) N\n",
    r"\(408,\) \(0\.0, 0\.0\)\n",
    "8 mm\n",
    "ball\n",
    r"\['(\[TxRxResult\] Communication success!)', '\1'\]\n2213 25\n",
)
FACES = ("gripper", "tactile", "motion", "recognition", "simulator", "cell")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("example", "printed"),
    [
        LONG(example, printed) if printed == "ball\n" else (example, printed)
        for example, printed in zip(EXAMPLES, PRINTED, strict=True)
    ],
)
def test_the_examples_run_as_they_are_printed(example, printed, capsys) -> None:
    exec(compile(example, "example", "exec"), {})
    assert re.fullmatch(printed, capsys.readouterr().out)


@pytest.mark.parametrize("package", FACES)
def test_each_name_of_a_face_is_what_type_checkers_see(package) -> None:
    module = import_module(package)
    stub = Path(str(module.__file__)).with_suffix(".pyi").read_text("utf-8")
    homes = {
        alias.name: f"{package}.{node.module}"
        for node in ast.parse(stub).body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    assert set(module.__all__) == homes.keys() == set(dir(module))
    for name, home in homes.items():
        assert getattr(module, name) is getattr(import_module(home), name)


@pytest.mark.parametrize("package", FACES)
def test_a_package_imports_nothing_before_it_is_used(package) -> None:
    imported = loaded(package)
    assert not imported & {"numpy", "scipy", *SERVOS, *CAN, "pydantic"}
    assert {name for name in imported if name.partition(".")[0] in FACES} == {package}


# -- What a program pays for an import -------------------------------------------------------------


CAN, SERVOS = ("can", "canopen"), ("serial", "dynamixel_sdk")


def loaded(modules: str) -> set[str]:
    """Return the modules that a new interpreter has loaded once it has imported some."""
    command = [sys.executable, "-c", f"import sys, {modules}; print(*sys.modules)"]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60)
    return set(done.stdout.split())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("modules", "later"),
    [
        ("cell.runtime.plugin", ("scipy", "matplotlib", *CAN, "dynamixel_sdk")),
        (
            "pytest_tactile_cell.fixtures, pytest_tactile_cell.options",
            ("numpy", "pydantic", *FACES),
        ),
        ("gripper, gripper.dynamixel.control_table, gripper.force.ramp", SERVOS),
        ("tactile.layout, tactile.frames, tactile.sensor.sensor", ("can",)),
    ],
)
def test_an_import_loads_nothing_of_what_only_a_later_use_needs(modules, later) -> None:
    assert not loaded(modules) & {*later}
