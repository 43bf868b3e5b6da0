"""What a host pays for loading the plugin, before it has a cell."""

import subprocess
import sys

MODULE = "cell.plugin.plugin"
LATER = ("scipy", "matplotlib", "canopen", "can", "dynamixel_sdk")


def test_the_plugin_is_loaded_without_libraries_that_only_a_cell_needs() -> None:
    code = f"import sys, {MODULE}; print(*{{*{LATER}}} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == ""
