"""Rows 38 and 39: configs and models that are refused before any device is touched."""

import os
import pickle
import re
import tempfile
from collections.abc import Callable
from functools import cache
from io import BytesIO
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

from benchmarks.fault_campaign.row import FaultRow, Observed
from benchmarks.fault_campaign.scenario import (
    campaign_config,
)
from cell.collect import pad_array
from cell.config import CellConfig
from cell.errors import CellError, ConfigError, ModelError
from cell.layouts import layout_from_config
from cell.model import save_model
from cell.plugin import TactileCellPlugin
from recognition.grasp import Grasp
from recognition.recognizers import make_trainer

# -- 38: configs -----------------------------------------------------------------------------


def _before_hardware(make: Callable[[], object], error: type[CellError]) -> tuple[str, bool]:
    """Return what was said, and whether a device was touched."""
    touched: list[object] = []

    def touch(*arguments: Any, **_options: Any) -> Any:
        touched.append(arguments)
        raise ConfigError("the cell was built")

    with mock.patch("cell.plugin.build_cell", touch):
        try:
            make()
        except error as refusal:
            return str(refusal), bool(touched)
    return "", True


def _bad_config(text: str, key: str) -> Observed:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "cell.yaml"
        path.write_bytes(text.encode())
        said, touched = _before_hardware(lambda: TactileCellPlugin(path), ConfigError)
    said = said.replace(f"{folder}/", "")
    placed = re.match(r"cell\.yaml:\d+:\d+: ", said) is not None and key in said
    return Observed(
        reaction="REJECT" if placed and not touched else "TAKEN",
        detected_after_s=None,
        outcome=said,
    )


# -- 39: models ------------------------------------------------------------------------------


@cache
def _model(layout: str = "paper") -> bytes:
    pads = pad_array(layout_from_config(CellConfig().tactile.model_copy(update={"layout": layout})))
    rng = np.random.default_rng(1)
    grasps = [
        Grasp(
            pads=pads,
            counts=rng.integers(0, 40 + 40 * number, (30, pads.n_taxels)).astype(np.uint16),
            t_s=np.arange(30) * 0.02,
            aperture_m=np.linspace(0.02, 0.01, 30),
            force_n=np.linspace(0.0, 6.0, 30),
            label=label,
        )
        for number, label in enumerate(("ball", "box"))
        for _ in range(4)
    ]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "m.npz"
        save_model(
            path,
            make_trainer("shrinkage_lda").fit(grasps),
            trainer_name="shrinkage_lda",
            pads=pads,
        )
        return path.read_bytes()


class _Evil:
    """Makes a folder when it is unpickled."""

    def __init__(self, marker: Path) -> None:
        self._marker = marker

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (str(self._marker),)


def _bad_model(content: Callable[[Path], bytes]) -> Observed:
    """Load a model file whose content is made knowing where code that runs leaves its mark."""
    with tempfile.TemporaryDirectory() as folder:
        path, marker = Path(folder) / "m.npz", Path(folder) / "code-was-run"
        path.write_bytes(content(marker))
        said, touched = _before_hardware(
            lambda: TactileCellPlugin(campaign_config(), model=path), ModelError
        )
        run = marker.exists()
    refused = said != "" and not touched and not run
    return Observed(
        reaction="REJECT" if refused else "CODE RUN" if run else "TAKEN",
        detected_after_s=None,
        outcome=said.replace(f"{folder}/", ""),
    )


def _flipped_model(_marker: Path) -> bytes:
    data = bytearray(_model())
    data[len(data) // 2] ^= 0x01
    return bytes(data)


def _other_version(_marker: Path) -> bytes:
    with np.load(BytesIO(_model()), allow_pickle=False) as archive:
        arrays = {name: archive[name] for name in archive.files}
    text = str(arrays["model"]).replace("tactile-cell-model/1", "tactile-cell-model/9")
    file = BytesIO()
    np.savez(file, **arrays | {"model": np.array(text)})
    return file.getvalue()


def _pickle(marker: Path) -> bytes:
    data = pickle.dumps(_Evil(marker))
    pickle.loads(data)  # what the product must not do: it leaves the mark
    marker.rmdir()
    return data


def _pickle_in_npz(marker: Path) -> bytes:
    file = BytesIO()
    np.savez(file, model=np.array([_Evil(marker)], dtype=object))
    return file.getvalue()


def _bomb(_marker: Path) -> bytes:
    """State in the directory of the archive that an array unpacks to 2 GiB."""
    data = bytearray(_model())
    entry = data.index(b"PK\x01\x02")
    data[entry + 24 : entry + 28] = (2 << 30).to_bytes(4, "little")
    return bytes(data)


def _config_rows() -> list[FaultRow]:
    texts = (
        ("corrupt", "gripper: {force_max_n: [\n", "not YAML"),
        ("partial", "gripper:\n  force_max_n: 1", "cut off"),
        ("duplicate key", "gripper:\n  force_max_n: 5\n  force_max_n: 50\n", "force_max_n"),
        ("NaN", "gripper:\n  force_max_n: .nan\n", "gripper.force_max_n"),
        ("out of range", "gripper:\n  force_max_n: 51.0\n", "gripper.force_max_n"),
        ("misspelt", "gripper:\n  forc_max_n: 5.0\n", "is force_max_n meant"),
        ("wrong type", "gripper:\n  force_max_n: '5'\n", "gripper.force_max_n"),
        ("alias bomb", "a: &a [x, x]\nb: &b [*a, *a]\nc: [*b, *b]\n", "aliases"),
    )
    return [
        FaultRow(
            row=38,
            variant=variant,
            fault=f"config: {variant}",
            injected=f"`{text.strip().splitlines()[-1].strip()}`",
            reaction="REJECT",
            limit_s=None,
            run=lambda text=text, key=key: _bad_config(text, key),
        )
        for variant, text, key in texts
    ]


def _model_rows() -> list[FaultRow]:
    contents: tuple[tuple[str, Callable[[Path], bytes]], ...] = (
        ("corrupt", _flipped_model),
        ("cut off", lambda _marker: _model()[:-400]),
        ("other taxel map", lambda _marker: _model("pinch")),
        ("other version", _other_version),
        ("pickle", _pickle),
        ("pickle in an archive", _pickle_in_npz),
        ("archive that unpacks to 2 GiB", _bomb),
    )
    return [
        FaultRow(
            row=39,
            variant=variant,
            fault=f"model: {variant}",
            injected="bytes of the file",
            reaction="REJECT",
            limit_s=None,
            run=lambda content=content: _bad_model(content),
        )
        for variant, content in contents
    ]


ROWS: tuple[FaultRow, ...] = (*_config_rows(), *_model_rows())
