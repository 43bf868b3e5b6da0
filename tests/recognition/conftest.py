"""A small generator of grasps: soft patches of known size on two pads, pressed along a ramp."""

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from recognition.grasp import Grasp, PadArray
from recognition.recognizers import make_trainer
from tests.values import make_pads


@dataclass(frozen=True)
class MadeObject:
    label: str
    width_mm: float
    length_mm: float
    sharpness: float
    opening_mm: float
    softness_mm: float


OBJECTS = (
    MadeObject("bar", 2.5, 9.0, 2.0, 12.0, 0.2),
    MadeObject("block", 5.0, 6.0, 6.0, 30.0, 0.1),
    MadeObject("disc", 4.5, 4.5, 4.0, 20.0, 0.3),
    MadeObject("egg", 4.0, 6.0, 1.0, 45.0, 0.6),
    MadeObject("pin", 2.0, 2.5, 2.0, 6.0, 0.1),
)


def make_grasp(
    made: MadeObject,
    rng: np.random.Generator,
    *,
    pads: PadArray,
    gripping: Sequence[int] = (0, 1),
    n_before: int = 8,
    n_ramp: int = 30,
    load: float = 0.5,
    noise_counts: float = 0.0,
    start_ms: int = 0,
) -> Grasp:
    n = n_before + n_ramp
    progress = np.concatenate([np.zeros(n_before), np.linspace(0.05, 1.0, n_ramp)])
    load = load * float(rng.uniform(0.85, 1.15))
    values = np.zeros((n, pads.n_taxels))
    angle = float(rng.normal(0.0, 0.15))
    centre = rng.normal(0.0, 1.5, 2)
    for pad in gripping:
        taxels = pads.taxels_of(pad)
        dx, dy = (pads.taxel_xy_m[taxels] * 1e3 - centre).T
        u = (np.cos(angle) * dx + np.sin(angle) * dy) / made.length_mm
        v = (np.cos(angle) * dy - np.sin(angle) * dx) / made.width_mm
        grown = np.sqrt(0.4 + 0.6 * progress)[:, None]
        patch = np.exp(-(((u * u + v * v) / grown**2) ** (made.sharpness / 2)))
        values[:, taxels] = load * progress[:, None] * patch * float(rng.uniform(0.95, 1.05))
    counts = values * pads.adc_max
    if noise_counts:
        counts += np.clip(np.abs(rng.normal(0.0, noise_counts / 2, counts.shape)), 1, noise_counts)
    opening_mm = made.opening_mm + float(rng.normal(0.0, 0.3)) - made.softness_mm * progress
    opening_mm[:n_before] += np.linspace(20.0, 1.0, n_before)
    return Grasp(
        pads=pads,
        counts=np.clip(np.round(counts), 0, pads.adc_max).astype(np.uint16),
        t_s=np.arange(n) / 30.0,
        aperture_m=opening_mm * 1e-3,
        force_n=np.full(n, np.nan),
        label=made.label,
        start_ms=start_ms,
    )


def make_grasps(
    n: int, *, seed: int, pads: PadArray, objects: Sequence[MadeObject] = OBJECTS, **options
) -> list[Grasp]:
    rng = np.random.default_rng(seed)
    return [
        make_grasp(made, rng, pads=pads, start_ms=1000 * i, **options)
        for made in objects
        for i in range(n)
    ]


def grasp_of(pads: PadArray, counts: Any, force_n: Any = np.nan, label: str = "") -> Grasp:
    """Return a grasp of these counts, 20 ms apart, without an opening."""
    n = len(counts)
    return Grasp(
        pads=pads,
        counts=np.clip(np.round(counts), 0, pads.adc_max),
        t_s=0.02 * np.arange(n),
        aperture_m=np.full(n, np.nan),
        force_n=np.broadcast_to(force_n, n),
        label=label,
    )


def part(grasp: Grasp, frames: Any) -> Grasp:
    """Return some frames of a grasp, 20 ms apart."""
    taken = {name: getattr(grasp, name)[frames] for name in ("counts", "aperture_m", "force_n")}
    return replace(grasp, t_s=0.02 * np.arange(len(taken["counts"])), **taken)


def accuracy(recognizer, grasps: Sequence[Grasp]) -> float:
    return np.mean([recognizer.posterior(g).best == g.label for g in grasps])


@pytest.fixture(scope="session")
def pads() -> PadArray:
    return make_pads()


@pytest.fixture(scope="session")
def train(pads) -> list[Grasp]:
    return make_grasps(8, seed=1, pads=pads)


@pytest.fixture(scope="session")
def fresh(pads) -> list[Grasp]:
    return make_grasps(5, seed=2, pads=pads)


@pytest.fixture(scope="session")
def teach(train: list[Grasp]) -> Callable[..., Any]:
    """Return what teaches a recognizer some objects, or all; each is taught once."""

    @functools.cache
    def taught(name: str, *labels: str, use_aperture: bool = True) -> Any:
        some = [grasp for grasp in train if grasp.label in labels or not labels]
        return make_trainer(name, use_aperture=use_aperture).fit(some)

    return taught
