"""A sensor of another package that hangs or raises in the process of the force loop."""

import contextlib
from collections.abc import Iterator
from pathlib import Path

import pytest

from cell import plugins
from cell.build import build_cell
from cell.config.file import changed_config, load_config, parse_config
from cell.control.plan import GraspStep, Pose
from cell.control.states import CellState
from cell.errors import HandLost
from cell.hand.client import HandProcess
from cell.pytest_plugin.process import CellProcess
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


@pytest.mark.parametrize(
    ("how", "named"),
    [
        ("blocks", "faulty of faulty-sensor 1.0.0 has not returned for"),
        ("spins", "faulty of faulty-sensor 1.0.0 has not returned for"),
        ("raises", "faulty of faulty-sensor 1.0.0 failed: ZeroDivisionError: division by zero"),
    ],
)
def test_code_that_goes_wrong_is_a_fault_that_keeps_the_grip(
    how: str, named: str, simulator: CellProcess, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    entries = {"tactile_cell.sensors": {"faulty": "tests.hil.faulty_sensor:FaultyConfig"}}
    install(tmp_path / "target", "faulty-sensor", entries)
    monkeypatch.syspath_prepend(str(tmp_path / "target"))
    plugins._entries.cache_clear()
    trigger = tmp_path / "trigger"
    sensor = {"kind": "faulty", "trigger": str(trigger), "how": how}
    config = changed_config(load_config(simulator.config_path), {"tactile.sensor": sensor})
    with contextlib.closing(build_cell(config)) as cell:
        controller = cell.controller
        assert isinstance(controller.hand, HandProcess)
        controller.start()
        controller.moves.present("box")
        pid = controller.hand.pid
        thread = in_a_grasp(cell, simulator, trigger.touch)
        with pytest.raises(PluginFault, match=named):
            controller.grasp(GraspStep(pose=Pose(), force_n=6.0))
        thread.join()
        assert controller.life.state is CellState.ABORTED
        assert controller.life.holding
        assert simulator.grip_n() > 1.0
        # The process of the loop still obeys: the part is let go by command.
        assert controller.hand.pid == pid
        trigger.unlink()
        controller.life.clear()
        assert simulator.grip_n() > 1.0
        controller.release_held()
        assert simulator.grip_n() == 0.0
        with contextlib.suppress(HandLost):
            controller.life.reset()
    plugins._entries.cache_clear()
