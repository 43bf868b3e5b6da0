"""A sensor of another package that hangs or raises in the process of the force loop."""

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from cell import plugins
from cell.build import build_cell
from cell.config.file import changed_config, load_config, parse_config
from cell.config.model import CellConfig
from cell.control.plan import GraspStep, Pose
from cell.control.states import CellState
from cell.errors import HandLost
from cell.hand.client import HandProcess
from pytest_tactile_cell.process import CellProcess
from tactile.errors import PluginFault
from tests.cell.sensors.packages import install
from tests.hil.program import CONFIG, first
from tests.hil.test_force_loop_process import in_a_grasp

pytestmark = pytest.mark.real_time
OBJECTS = "sequence: {x_mm: [0, 0], y_mm: [0, 0], force_n: [3, 5], max_grasps: 1}\n"


@pytest.fixture(scope="module")
def simulator(free_machine: None) -> Iterator[CellProcess]:
    one = CellProcess(parse_config(CONFIG + OBJECTS, source="test"))
    first(one.pid)
    yield one
    one.end()


@pytest.fixture
def faulty(
    simulator: CellProcess, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Callable[[str], CellConfig]]:
    """Return the maker of configs whose sensor goes wrong once the file `trigger` is there."""
    entries = {"tactile_cell.sensors": {"faulty": "tests.hil.faulty_sensor:FaultyConfig"}}
    install(tmp_path / "target", "faulty-sensor", entries)
    monkeypatch.syspath_prepend(str(tmp_path / "target"))
    plugins._entries.cache_clear()

    def config(how: str) -> CellConfig:
        sensor = {"kind": "faulty", "trigger": str(tmp_path / "trigger"), "how": how}
        return changed_config(load_config(simulator.config_path), {"tactile.sensor": sensor})

    yield config
    plugins._entries.cache_clear()


@pytest.mark.parametrize(
    ("how", "fault"),
    [
        ("blocks", (HandLost, "has sent nothing for 1 s")),
        pytest.param(*("spins", (HandLost, "has sent nothing for 1 s")), marks=pytest.mark.long),
        pytest.param(
            "raises",
            (PluginFault, "faulty of faulty-sensor 1.0.0 failed: ZeroDivisionError: divis"),
            marks=pytest.mark.long,
        ),
    ],
)
def test_code_that_goes_wrong_is_a_fault_that_keeps_the_grip(
    how: str,
    fault: tuple[type[Exception], str],
    faulty: Callable[[str], CellConfig],
    simulator: CellProcess,
    tmp_path: Path,
) -> None:
    (error, named), trigger = fault, tmp_path / "trigger"
    with contextlib.closing(build_cell(faulty(how))) as cell:
        controller = cell.controller
        assert isinstance(controller.hand, HandProcess)
        controller.hand._silence_s = 1.0
        controller.start()
        controller.moves.present("box")
        pid = controller.hand.pid
        thread = in_a_grasp(cell, simulator, trigger.touch)
        with pytest.raises(error, match=named):
            controller.grasp(GraspStep(pose=Pose(), force_n=6.0))
        thread.join()
        assert controller.life.state is CellState.ABORTED
        assert controller.life.holding
        assert simulator.grip_n() > 1.0
        trigger.unlink()
        controller.life.clear()
        # Code that raises an error leaves the process of the loop alive.
        assert (controller.hand.pid == pid) == (error is PluginFault)
        controller.life.reset()
        controller.release_held()
        assert simulator.grip_n() == 0.0
