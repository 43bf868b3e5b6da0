"""Small simulated cells, their grasps, and what tests do with them."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from typer.testing import CliRunner

from cell.config.file import changed_config
from cell.config.model import CellConfig
from cell.control.lifecycle import CellLifecycle
from cell.interfaces.cli.app import app
from gripper.values.state import GripperPhase
from pytest_tactile_cell.virtual import VirtualCell
from recognition.grasp import Grasp
from recognition.recognizer import Posterior
from simulator.clock import VirtualClock
from tests.values import make_pads


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
    """As `small_config`, with coarse pads, a shorter zero and way; no shapes, no taught model."""
    quick = {
        "tactile.layout": COARSE_PADS,
        "tactile.tare_frames": 10,
        "gripper.aperture_open_mm": 12.0,
        "recognition.shape": False,
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


MakeBench = Callable[..., Bench]
"""Maker of simulated cells; takes a config and what `build_cell` takes."""


def plain_grasp(label: str, **changes: Any) -> Grasp:
    """Twelve frames of random counts while the fingers close from 40 to 10 mm."""
    pads, n = make_pads(((4, 3), (4, 3))), 12
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
