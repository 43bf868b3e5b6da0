"""The simulated cell as a process: who may serve in a folder."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from cell.config.model import CellConfig
from cell.errors import CellError
from cell.jobs import simulate


def test_a_folder_serves_one_simulated_cell_at_a_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, make_config: Callable[..., CellConfig]
) -> None:
    folder = tmp_path / "sim"
    served: list[Path] = []

    def serve_here() -> None:
        simulate.serve_simulated_cell(
            make_config(), frames=None, folder=folder, announce=lambda _line: None
        )

    def serve(_settings: Any, _announce: Any, *, folder: Path, **_options: Any) -> None:
        served.append(folder)
        if len(served) == 1:
            with pytest.raises(CellError, match="name another folder with --out"):
                serve_here()

    monkeypatch.setattr(simulate, "serve", serve)
    serve_here()
    serve_here()
    assert served == [folder, folder]
