"""Simulated cells that several tests of the cell share."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cell.build import Cell, build_cell
from cell.config.file import changed_config
from cell.config.model import CellConfig
from cell.control.controller import CellController
from cell.control.plan import GraspStep, Pose
from cell.data.dataset import read_dataset
from cell.jobs.run import MainResult, teach_and_identify
from gripper.state import GripperPhase
from recognition.grasp import Grasp, PadArray
from simulator.cell import SimulatedCell

MakeConfig = Callable[..., CellConfig]


def small_config(**changes: Any) -> CellConfig:
    """Two objects and a short zero; the rest as built in."""
    small = {
        "tactile.tare_frames": 25,
        "simulator.objects": [
            {"label": "ball", "shape": "sphere:diameter=9.5mm"},
            {"label": "box", "shape": "box:length=15.9mm,width=10mm,height=10mm"},
        ],
    }
    wanted = {path.replace("__", "."): value for path, value in changes.items()}
    return changed_config(CellConfig(), small | wanted)


@dataclass
class Bench:
    """A cell in virtual time, and what only the simulator can tell of it."""

    cell: Cell

    @property
    def controller(self) -> CellController:
        return self.cell.controller

    @property
    def simulated(self) -> SimulatedCell:
        assert self.cell.simulated is not None
        return self.cell.simulated

    @property
    def grip_n(self) -> float:
        """Force on the pad that carries less."""
        return min(self.simulated.world.contact_force_n())

    def sleep(self, seconds: float) -> None:
        self.simulated.clock.sleep(seconds)

    def ready(self, label: str | None = "ball") -> "Bench":
        self.controller.start()
        self.controller.present(label)
        return self

    def grasp(self, force_n: float = 3.0, pose: Pose | None = None) -> Any:
        return self.controller.grasp(GraspStep(pose=pose or Pose(), force_n=force_n))

    def once_in(self, phase: GripperPhase, act: Callable[[], object], after_s: float = 0.0) -> None:
        """Do something once, when the gripper has been in a phase for so long."""
        since_s: list[float] = []
        done: list[bool] = []

        def look(now_s: float) -> None:
            if not done and self.controller.gripper.state is phase:
                since_s.append(now_s)
                if now_s - since_s[0] >= after_s:
                    done.append(True)
                    act()

        self.simulated.clock.on_advance.append(look)


@pytest.fixture
def make_config() -> MakeConfig:
    """Return the maker of a small config; takes changes as ``tactile__node_id=7``."""
    return small_config


@pytest.fixture
def make_bench() -> Iterator[Callable[..., Bench]]:
    """Return the maker of simulated cells; takes a config and what `build_cell` takes."""
    cells: list[Cell] = []

    def make(config: CellConfig | None = None, **options: Any) -> Bench:
        cells.append(build_cell(config or small_config(), **options))
        return Bench(cells[-1])

    yield make
    for cell in cells:
        cell.close()


@pytest.fixture
def bench(make_bench: Callable[..., Bench]) -> Bench:
    return make_bench()


@dataclass(frozen=True)
class Taught:
    """A small run of the main job, with its files."""

    config: CellConfig
    folder: Path
    result: MainResult
    grasps: tuple[Grasp, ...]
    progress: tuple[tuple[str, int, int], ...]


@pytest.fixture(scope="session")
def taught(tmp_path_factory: pytest.TempPathFactory) -> Taught:
    """Two objects, five grasps each, one identification of each."""
    folder = tmp_path_factory.mktemp("taught")
    config = small_config()
    progress: list[tuple[str, int, int]] = []
    cell = build_cell(config, folder=folder)
    try:
        cell.controller.start()
        result = teach_and_identify(
            cell,
            config,
            labels=["ball", "box"],
            n_teach=5,
            n_trials=1,
            folder=folder,
            progress=lambda *step: progress.append(step),
        )
    finally:
        cell.close()
    assert result.dataset is not None
    return Taught(config, folder, result, read_dataset(result.dataset), tuple(progress))


def plain_pads(*shapes: tuple[int, int]) -> PadArray:
    """Pads with taxels 3 mm apart, 12 bit."""
    return PadArray(
        pad_shape=np.array(shapes),
        taxel_pad=np.repeat(np.arange(len(shapes)), [rows * columns for rows, columns in shapes]),
        taxel_xy_m=np.concatenate([np.indices(shape).reshape(2, -1).T * 3e-3 for shape in shapes]),
        adc_max=4095,
    )


def plain_grasp(
    label: str, shapes: tuple[tuple[int, int], ...] = ((4, 3), (4, 3)), **changes: Any
) -> Grasp:
    """Twelve frames of random counts while the fingers close from 40 to 10 mm."""
    pads = plain_pads(*shapes)
    n = 12
    values: dict[str, Any] = {
        "pads": pads,
        "counts": np.random.default_rng(len(label)).integers(0, 4096, (n, pads.n_taxels)),
        "t_s": np.arange(n) * 0.03,
        "aperture_m": np.linspace(0.04, 0.01, n),
        "force_n": np.linspace(0.0, 5.0, n),
        "label": label,
    }
    return Grasp(**(values | changes))


@pytest.fixture
def make_grasp() -> Callable[..., Grasp]:
    """Return the maker of grasps without meaning; takes label, pad shapes and changes."""
    return plain_grasp
