"""Simulated cells that several tests of the cell share."""

from collections.abc import Callable
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from importlib import import_module
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from cell.build import build_cell
from cell.config.file import changed_config
from cell.config.model import CellConfig
from cell.control.lifecycle import CellLifecycle
from cell.control.self_zero import zero_text
from cell.control.zeroing import Zeroing
from cell.interfaces.cli.app import app
from cell.recording.dataset import read_dataset
from cell.runtime.main_job import MainResult, teach_and_identify
from cell.runtime.plugin import TactileCellPlugin
from gripper.values.state import GripperPhase
from pytest_tactile_cell.virtual import VirtualCell
from recognition.drift.self_zero import ZeroMeasurement
from recognition.grasp import Grasp, SelfZero
from recognition.recognizer import Posterior
from simulator.clock import VirtualClock
from tests.values import make_pads

WHOLE = {"make_bench", "make_plugin", "make_stand", "grasped", "taught"}
WHOLE |= {"open_page", "fleet", "aged"}
"""Fixtures of whole cells, browsers and fleets."""


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the tests of whole cells: they are slow."""
    for item in items:
        if WHOLE & {*getattr(item, "fixturenames", ())}:
            item.add_marker("slow")


def call(*arguments: object, answers: str = "") -> str:
    """Run a command that succeeds; return what it printed."""
    words = [str(a) for a in arguments]
    result = CliRunner().invoke(app, words, input=answers, catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.stdout


def small_config(**changes: Any) -> CellConfig:
    """Two objects, a short zero and way, a self-zero on demand; the rest as built in."""
    small = {
        "self_zero": "on_demand",
        "gripper.aperture_open_mm": 14.0,
        "tactile.tare_frames": 25,
        "simulator.objects": [
            {"label": "ball", "shape": "sphere:diameter=9.5mm"},
            {"label": "box", "shape": "box:length=15.9mm,width=10mm,height=10mm"},
        ],
    }
    wanted = {path.replace("__", "."): value for path, value in changes.items()}
    return changed_config(CellConfig(), small | wanted)


COARSE_PADS = {
    "name": "coarse",
    "adc_max": 255,
    "pads": [
        {"finger": finger, "face": "inner", "rows": 6, "columns": 3}
        | {"pitch_x_mm": 5.0, "pitch_y_mm": 5.0}
        for finger in (0, 1)
    ],
}
"""One pad of 6 x 3 taxels on each finger: frames of six messages."""


def quick_config(**changes: Any) -> CellConfig:
    """As `small_config`, with coarse pads, a shorter zero and way; for no taught model."""
    quick = {
        "tactile.layout": COARSE_PADS,
        "tactile.tare_frames": 10,
        "gripper.aperture_open_mm": 12.0,
    }
    return small_config(**quick | changes)


REAL = {
    "gripper.port": "/dev/ttyUSB0",
    "tactile.interface": "socketcan",
    "tactile.channel": "can0",
    "positioner.kind": "operator",
}
"""Ports of a real cell."""


def once(
    clock: VirtualClock,
    happens: Callable[[], bool],
    act: Callable[[], object],
    after_s: float = 0.0,
) -> list[float]:
    """Do something once, when so long has passed since a condition was met first.

    Returns the list that gets the time in s.
    """
    since_s: list[float] = []
    done_s: list[float] = []

    def look(now_s: float) -> None:
        if not done_s and happens():
            since_s.append(now_s)
            if now_s - since_s[0] >= after_s:
                done_s.append(now_s)
                act()

    clock.on_advance.append(look)
    return done_s


@dataclass(frozen=True, kw_only=True)
class Bench(VirtualCell):
    """A cell in virtual time that can be acted on in its phases."""

    @property
    def life(self) -> CellLifecycle:
        return self.controller.life

    def ready(self, label: str = "ball") -> "Bench":
        self.start(label)
        return self

    def once_in(
        self, phase: GripperPhase, act: Callable[[], object], after_s: float = 0.0
    ) -> list[float]:
        """Do something once, when the gripper has been in a phase for so long; as `once`."""
        return once(self.clock, lambda: self.controller.hand.phase is phase, act, after_s)


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


MakeBench = Callable[..., Bench]
"""Maker of simulated cells; takes a config and what `build_cell` takes."""


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
    return Taught(config, result, read_dataset(result.dataset), tuple(progress))


def plain_grasp(label: str, **changes: Any) -> Grasp:
    """Twelve frames of random counts while the fingers close from 40 to 10 mm."""
    pads = make_pads(((4, 3), (4, 3)))
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


class Scripted:
    """A recognizer that gives these answers, the last one again and again, and notes what it sees.

    Each answer is the share of the first label, and the probability of an unknown object.
    """

    name, labels, uses_aperture = "scripted", ("ball", "box"), False

    def __init__(
        self,
        *answers: tuple[float, float],
        drawn_m: tuple[float, ...] = (),
        look: Callable[[], object] = lambda: None,
    ) -> None:
        self._answers = list(answers)
        self._drawn_m = drawn_m
        self._look = look
        self.grasps: list[Grasp] = []
        self.seen: list[Any] = []
        """What ``look`` has returned at each."""

    def posterior(self, grasp: Grasp) -> Posterior:
        assert grasp.label == ""
        self.grasps.append(grasp)
        self.seen.append(self._look())
        share, unknown = self._answers.pop(0) if len(self._answers) > 1 else self._answers[0]
        return Posterior(
            labels=self.labels,
            probability=np.array([share, 1.0 - share]),
            unknown=unknown,
            drawn_m=self._drawn_m,
        )


SURE, UNSURE, STRANGE = (0.9999, 0.001), (0.6, 0.01), (0.9, 0.999)
"""Answers: the first label, either, and neither."""


from tests.cell.served import (  # noqa: E402, F401  it takes `small_config` from here
    make_plugin,
    plugin,
    serve,
    tls,
)
