"""What a program pays for an import: libraries that only a later use needs are not loaded by it."""

import subprocess
import sys

import pytest

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
        ("cell.plugin.plugin", ("scipy", "matplotlib", *CAN, "dynamixel_sdk")),
        ("cell.interfaces.web", ("prometheus_client",)),
        (
            "pytest_tactile_cell",
            (
                "numpy",
                "pydantic",
                "cell",
                "gripper",
                "tactile",
                "motion",
                "recognition",
                "simulator",
            ),
        ),
        (
            "gripper, gripper.dynamixel.control_table, gripper.force.ramp, "
            "gripper.force.estimates.force_estimate",
            SERVOS,
        ),
        (
            "tactile.layout, tactile.frames.assembler, tactile.control_unit.object_dictionary, "
            "tactile.frames.force_message, tactile.sensor.sensor",
            ("can",),
        ),
    ],
)
def test_an_import_loads_nothing_of_what_only_a_later_use_needs(modules, later) -> None:
    assert not loaded(modules) & {*later}
