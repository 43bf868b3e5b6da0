"""Archives of small fleets that several tests share."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from cell.archive.ingest import ingest, sources
from cell.data.dataset import write_dataset
from cell.jobs.common import silent
from recognition.grasp import Grasp
from tests.cell.archive.fleet import ramp, record_fleet


@dataclass(frozen=True)
class Fleet:
    """Ten days of two cells, of which one ages."""

    archive: str
    other_objects: Path


@pytest.fixture(scope="session")
def aged(tmp_path_factory: pytest.TempPathFactory) -> Fleet:
    folder = tmp_path_factory.mktemp("aged")
    record_fleet(folder / "recordings", n_days=10, n_each=1)
    target = str(folder / "archive")
    ingest(target, sources([folder / "recordings"]), progress=silent)
    grasp = ramp("ball", np.random.default_rng(1))
    values = {name: getattr(grasp, name) for name in Grasp.__dataclass_fields__}
    write_dataset(folder / "others.npz", [Grasp(**values | {"label": "cup"})])
    return Fleet(target, folder / "others.npz")


@pytest.fixture
def untaught(tmp_path: Path) -> str:
    """Return an archive without an identification."""
    rng, target = np.random.default_rng(2), str(tmp_path / "untaught")
    write_dataset(tmp_path / "a.npz", [ramp("ball", rng, start_ms=i) for i in range(3)])
    ingest(target, [tmp_path / "a.npz"], progress=silent)
    return target
