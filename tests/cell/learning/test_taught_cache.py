"""The model of the built-in cell in the user's cache: found by what it was taught with, or not."""

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from cell.interfaces.cli.commands.run import _keep_for_serve
from cell.learning import taught_cache
from cell.learning.taught_cache import MODEL_FILE, cached_model, keep_model
from tests.cell.conftest import small_config
from tests.values import raising


@pytest.fixture
def cached(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, taught: Any) -> Path:
    """A model in a cache of its own."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))

    def write(folder: Path) -> None:
        shutil.copyfile(taught.result.model, folder / MODEL_FILE)
        shutil.copyfile(taught.result.dataset, folder / "model.grasps.npz")

    return keep_model(taught.config, write)


def test_a_kept_model_is_found_and_replaced(cached, taught, tmp_path) -> None:
    assert cached_model(taught.config) == cached
    assert cached.is_relative_to(tmp_path / "tactile-cell")
    keep_model(taught.config, lambda folder: (folder / "other").touch())
    assert [path.name for path in cached.parent.iterdir()] == ["other"]
    assert len(list(cached.parent.parent.iterdir())) == 1


def test_a_model_of_another_config_or_version_is_not_found(cached, taught, monkeypatch) -> None:
    same = small_config(seed=taught.config.seed, serve__http_port=0, recording__directory="there")
    assert cached_model(same) == cached
    assert cached_model(small_config(simulator__noise_level=1.5)) is None
    monkeypatch.setattr(taught_cache, "version", lambda _name: "99")
    assert cached_model(taught.config) is None


@pytest.mark.parametrize(
    ("broken", "left"), [(MODEL_FILE, 1000), ("model.grasps.npz", 1000), ("model.grasps.npz", 0)]
)
def test_a_model_that_is_broken_or_cannot_be_extended_is_removed(
    cached, taught, broken, left
) -> None:
    path = cached.with_name(broken)
    data = path.read_bytes()[:left]
    path.unlink()
    if data:
        path.write_bytes(data)
    assert cached_model(taught.config) is None
    assert not cached.parent.exists()


def test_a_model_that_is_not_written_whole_changes_nothing(cached, taught) -> None:
    with pytest.raises(OSError, match="disk full"):
        keep_model(taught.config, raising(OSError("disk full")))
    assert cached_model(taught.config) == cached
    assert len(list(cached.parent.parent.iterdir())) == 1


def test_without_a_usable_variable_the_cache_is_that_of_the_home(
    tmp_path, monkeypatch, taught
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    for value in ("", "relative"):
        monkeypatch.setenv("XDG_CACHE_HOME", value)
        made = keep_model(taught.config, lambda folder: (folder / MODEL_FILE).touch())
        assert made.is_relative_to(tmp_path / ".cache" / "tactile-cell")


def test_a_run_that_has_taught_all_objects_keeps_its_model(tmp_path, monkeypatch, taught) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    _keep_for_serve(replace(taught.result, labels=("ball",)), taught.config)
    assert cached_model(taught.config) is None
    _keep_for_serve(taught.result, taught.config)
    assert cached_model(taught.config) is not None
