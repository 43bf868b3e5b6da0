"""Files of this version, made once for each release: `python -m tests.formats.write`."""

import json
import os
import shutil
from importlib.metadata import version
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import Any, cast

from cell.commissioning.bench import Bench
from cell.commissioning.engine import Engine
from cell.commissioning.walk import all_steps
from cell.config.file import config_text
from cell.control.states import CellState, GraspState
from cell.fault_catalogue import CATALOGUE
from cell.service.history import History
from simulator.cell import SimulatedCell
from simulator.settings import SimulatorSettings
from tactile.layout import pinch_layout
from tests.cell.cells import call, quick_config
from tests.cell.commissioning.hands import Person, SimulatedLines
from tests.cell.commissioning.test_servo_bench import SimulatedBench, measured


def numbers() -> dict[str, dict[str, int]]:
    """Return the numbers that hosts know."""
    return {
        "faults": {kind.__name__: fault.number for kind, fault in CATALOGUE.items()},
        "states": {state.value: state.number for state in CellState},
        "grip": {state.value: state.number for state in GraspState},
    }


def main() -> None:
    """Write each kind of file to a new folder beside this one, named after the version."""
    with TemporaryDirectory() as folder:
        # Files name the folder that they were made in.
        os.chdir(folder)
        make_files()
        shutil.copytree(folder, Path(__file__).parent / version("tactile-cell"))


def make_files() -> None:
    """Write the files to the working folder."""
    Path("numbers.json").write_text(json.dumps(numbers(), indent=1) + "\n")
    Path("bench").mkdir()
    measured(SimulatedBench(), Path("bench"), "registers", "velocity", "scale", "free")
    (result,) = Path("bench").glob("*.json")
    servos = [{"id": one, "model": "XM430-W350", "measured": str(result)} for one in (1, 2)]
    jobs = {"recording__directory": "jobs", "sequence__max_grasps": 1, "recognition__shape": True}
    config = quick_config(name="press-4", gripper__servos=servos, **jobs)
    Path("tactile-cell.yaml").write_text(config_text(config, comments=False))
    for part in ("ball", "box"):
        call("teach", part, "-n", 4, "-o", "parts.npz")
    call("model", "train", "parts.npz", "-o", "default.model.npz")
    call("model", "train", "parts.npz", "-o", "parts.model.npz", "--recognizer", "level_check")
    call("hand", "zero", "-c", "tactile-cell.yaml")
    for job in Path("jobs").glob("*-*/"):
        shutil.rmtree(job)
    call("identify", "-m", "parts.model.npz", "--object", "ball")
    call("archive", "add", "parts.npz", "--to", "archive", "--cell", "press-4")
    status = cast(Any, SimpleNamespace(n_faults=0, fault=None))
    history = History(Path("jobs/history-press-4.sqlite3"), lambda: status)
    history.update()
    history.close()
    with SimulatedCell(SimulatorSettings(layout=pinch_layout(), aperture_m=0.03)) as cell:
        given = {"tactile.interface": "socketcan", "tactile.channel": "can0"}
        bench = Bench(Path("commissioned"), SimulatedLines(cell), given=given)
        Engine(all_steps(), bench).run(Person(cell).script)
    for large in ("*.html", "*.csv", "*.md", "*.schema.json"):
        for path in Path().rglob(large):
            path.unlink()


if __name__ == "__main__":
    main()
