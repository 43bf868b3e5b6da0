"""The template package of docs/how-to/add.md: installed, and tried by what that page prints."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from cell.config.file import parse_config
from cell.config.tactile import layout_from_config
from tactile.layout import inner_pads
from tests.cell.sensors.packages import install_project

ROOT = Path(__file__).parents[3]
PACKAGE = ROOT / "docs/examples/sensor-package"
PAGE = (ROOT / "docs/how-to/add.md").read_text(encoding="utf-8")


def run(folder: Path, target: Path, *command: str) -> str:
    """Run a command of an environment with the package; return what it prints."""
    env = os.environ | {"PYTHONPATH": os.pathsep.join((str(target), str(PACKAGE), str(ROOT)))}
    done = subprocess.run(command, check=False, cwd=folder, env=env, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_the_page_shows_the_files_of_the_package() -> None:
    shown = re.findall(r"```(?:python|toml)\n(.*?)```", PAGE, re.DOTALL)
    for name in ("pyproject.toml", "tactile_dfrobot/sensor.py", "tests/test_dfrobot.py"):
        assert (PACKAGE / name).read_text(encoding="utf-8") in shown, name
    code = [line for line in shown[1].splitlines() if line.strip() and line.strip()[0] != "#"]
    assert len(code) < 75


def test_the_layout_on_the_page_has_the_pads_of_the_sensor() -> None:
    (shown,) = re.findall(r"```yaml\n(tactile:\n  layout:.*?)```", PAGE, re.DOTALL)
    layout = layout_from_config(parse_config(shown, source="page").tactile)
    assert layout.name == "dfrobot_6x6"
    assert layout == inner_pads("dfrobot_6x6", 6, 6, 3e-3, adc_max=4095)


@pytest.mark.long
@pytest.mark.timeout(300)
def test_the_package_passes_what_the_page_prints(tmp_path: Path) -> None:
    target = tmp_path / "target"
    install_project(target, PACKAGE)
    (printed,) = re.findall(r"    pip install .*?\n((?:    .+\n)+)", PAGE)
    commands = [line.split() for line in printed.splitlines()]
    assert [command[0] for command in commands] == ["tactile-cell", "pytest", "pytest"]
    modules = {
        "tactile-cell": (sys.executable, "-c", "from cell.interfaces.cli import main; main()"),
        "pytest": (
            sys.executable,
            "-m",
            "pytest",
            "-p",
            "no:cacheprovider",
            f"--rootdir={PACKAGE}",
        ),
    }
    outputs = [run(PACKAGE, target, *modules[name], *rest) for name, *rest in commands]
    assert re.search(r"sensors +dfrobot +tactile-dfrobot 1\.0\.0 +loads", outputs[0])
    assert all(re.search(r"\d passed", text) for text in outputs[1:])
