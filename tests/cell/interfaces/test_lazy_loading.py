"""What a host pays for loading the plugin, before it has a cell."""

import subprocess
import sys

import pytest

MODULE = "cell.interfaces.plugin.plugin"


@pytest.mark.parametrize("library", ["scipy", "matplotlib", "canopen", "can", "dynamixel_sdk"])
def test_the_plugin_is_loaded_without_libraries_that_only_a_cell_needs(library: str) -> None:
    code = f"import sys, {MODULE}; print({library!r} in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"
