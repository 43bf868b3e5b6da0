"""Simulated cells that several tests of the cell share."""

import subprocess
from collections.abc import Callable
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

from cell.build import build_cell
from cell.config.model import CellConfig
from cell.control.zeroing import Zeroing, zero_text
from cell.recording.dataset import read_grasps
from cell.runtime.main_job import MainResult, teach_and_identify
from cell.runtime.plugin import TactileCellPlugin
from recognition.drift.self_zero import ZeroMeasurement
from recognition.grasp import Grasp, SelfZero
from tests.cell.cells import Bench, MakeBench, quick_config, small_config
from tests.cell.served import BRISK, Served, serving
from tests.waiting import LIMIT_S

WHOLE = {"make_bench", "make_plugin", "make_stand", "grasped", "taught"}
WHOLE |= {"open_page", "fleet", "aged"}
"""Fixtures of whole cells, browsers and fleets."""


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the tests of whole cells: they are slow."""
    for item in items:
        if WHOLE & {*getattr(item, "fixturenames", ())}:
            item.add_marker("slow")


@pytest.fixture
def made_up_zero(monkeypatch: pytest.MonkeyPatch) -> SelfZero:
    """A self-zero that closes no fingers, for tests of what becomes of one; return its value."""
    zero = SelfZero.from_values([1e-4, 1e-4, 0.1, 0.02, 8.0, 0.2])

    def measure(zeroing: Zeroing, *, asked: bool) -> ZeroMeasurement:
        measured = ZeroMeasurement(zero=replace(zero), tilt_rad=(0.0, 0.0), fit=1.0, dead=())
        zeroing.open()
        zeroing.zeros.keep(measured.zero)
        zeroing.journal.note("self_zero", zero_text(measured))
        return measured

    monkeypatch.setattr(Zeroing, "_measure", measure)
    return zero


@pytest.fixture
def make_bench(undo: ExitStack) -> MakeBench:
    """Return the maker, of quick cells by default; what it has made is closed at the end."""

    def make(config: CellConfig | None = None, **options: Any) -> Bench:
        chosen = config or quick_config()
        if folder := options.get("folder"):
            folder.mkdir(exist_ok=True)
        cell = undo.enter_context(closing(build_cell(chosen, **options)))
        return Bench(config=chosen, cell=cell, simulated=cell.simulated)

    return make


@pytest.fixture
def bench(make_bench: MakeBench) -> Bench:
    return make_bench()


@pytest.fixture
def meddle(monkeypatch: pytest.MonkeyPatch) -> Callable[[Callable[[Any], object]], list[Any]]:
    """Return what does something to each cell that a program builds, and returns their list."""

    def arrange(act: Callable[[Any], object]) -> list[Any]:
        built: list[Any] = []

        def build(*arguments: Any, **options: Any) -> Any:
            built.append(build_cell(*arguments, **options))
            act(built[-1])
            return built[-1]

        # All are imported first: one that is imported under the patch would keep it for good.
        users = [
            import_module(f"cell.{name}")
            for name in ("build", "interfaces.cli.session", "commissioning.doctor")
        ]
        for user in users:
            monkeypatch.setattr(user, "build_cell", build)
        return built

    return arrange


@dataclass(frozen=True)
class Taught:
    """A small run of the main job, with its files."""

    config: CellConfig
    result: MainResult
    grasps: tuple[Grasp, ...]
    progress: tuple[tuple[str, int, int], ...]


@pytest.fixture(scope="session")
def taught(tmp_path_factory: pytest.TempPathFactory) -> Taught:
    """Two objects, five grasps each, one identification of each.

    Five grasps teach little: one in ten is UNKNOWN then. With this seed the first ones are named.
    """
    folder = tmp_path_factory.mktemp("taught")
    config = small_config(seed=7)
    progress: list[tuple[str, int, int]] = []
    with TactileCellPlugin(config, folder=folder) as running:
        result = teach_and_identify(
            running,
            config,
            labels=["ball", "box"],
            n_teach=5,
            n_trials=1,
            folder=folder,
            progress=lambda *step: progress.append(step),
        )
    return Taught(config, result, read_grasps(result.model), tuple(progress))


@pytest.fixture
def serve(request: pytest.FixtureRequest, undo: ExitStack) -> Callable[..., Served]:
    """Return the maker of services; ``interfaces`` opens them.

    Each stands on a stub, or with ``cell``, options of the plugin, on a simulated cell that was
    taught.
    """

    def make(*interfaces: str, cell: dict[str, Any] | None = None, **more: Any) -> Served:
        if cell is not None:
            cell = {"model": request.getfixturevalue("taught").result.model} | cell
        return undo.enter_context(serving(*interfaces, cell=cell, **more))

    return make


@pytest.fixture
def tls(tmp_path: Path) -> dict[str, str]:
    """Options of a service that name a certificate of 127.0.0.1 and its key."""
    key, certificate = str(tmp_path / "key.pem"), str(tmp_path / "cert.pem")
    made = subprocess.run(
        ["openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1",
         "-nodes", "-days", "2", "-subj", "/CN=cell", "-addext", "subjectAltName=IP:127.0.0.1",
         "-keyout", key, "-out", certificate],
        capture_output=True, check=False,
    )  # fmt: skip
    if made.returncode:
        pytest.skip("openssl is not there to make a certificate")
    return {"serve__tls_certificate": certificate, "serve__tls_key": key}


@pytest.fixture
def make_plugin(undo: ExitStack) -> Callable[..., Any]:
    """Return the maker of plugins on simulated cells: small ones with a model, else quick ones."""

    def make(config: CellConfig | None = None, **options: Any) -> Any:
        usual = small_config(**BRISK) if options.get("model") else quick_config()
        plugin = TactileCellPlugin(config or usual, **options)
        undo.callback(plugin.close, LIMIT_S)
        return plugin

    return make


@pytest.fixture
def plugin(make_plugin: Any, taught: Any) -> Any:
    """A plugin that knows ball and box."""
    return make_plugin(model=taught.result.model)
