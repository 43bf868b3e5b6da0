"""Growth of the default recogniser with the number of objects: teaching, model, answers.

With the folder of recorded grasps in TACTILE_CELL_DATA, objects beyond the 36 recorded ones are
copies of them: gain of each pad, offset of the opening and noise are drawn once for each copy.
Without it, simulated grasps of the paper's objects are copied. All grasps teach in a process of
its own, whose peak memory includes the grasps.
"""

import tempfile
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks._measure import in_own_process, line, quantile, repeats, timed
from benchmarks.recognition._grasps import grasps_at_hand
from cell.learning.model import save_model
from cell.learning.training import train
from recognition.drift.drift import Drift
from recognition.grasp import Grasp, by_label
from recognition.recognizers import DEFAULT_TRAINER

_OBJECTS = (36, 108, 360, 3600)
"""Numbers of objects: all at effort 1."""
_LOG_GAIN_SD, _OFFSET_SD_MM, _NOISE_COUNTS = 0.3, 8.0, 3.0
"""Deviations of a copy: of each pad's gain (log), of the opening, and the largest of its noise."""
_ANSWERS = 400
"""Grasps whose names are asked for."""


def copied(grasps: Sequence[Grasp], n_objects: int) -> list[Grasp]:
    """Return grasps of so many objects: the given ones, then copies of them."""
    members = list(by_label(grasps).values())
    found = [grasp for group in members[:n_objects] for grasp in group]
    for number in range(len(members), n_objects):
        turn, group = number // len(members), members[number % len(members)]
        rng = np.random.default_rng(number)
        gains = np.exp(rng.normal(0.0, _LOG_GAIN_SD, group[0].pads.n_pads))
        offset_mm, noise = rng.normal(0.0, _OFFSET_SD_MM), rng.uniform(0.0, _NOISE_COUNTS)
        other = Drift(gains=tuple(gains.tolist()), aperture_offset_m=1e-3 * offset_mm)
        for grasp in group:
            one = other.apply(grasp)
            noisy = one.counts + rng.normal(0.0, noise, one.counts.shape)
            counts = np.clip(noisy, 0, one.pads.adc_max)
            found.append(replace(one, counts=counts, label=f"{grasp.label} {turn:03d}"))
    return found


def cost(n_objects: int, n_answers: int) -> str:
    """Return what teaching of so many objects, its file and an answer take, as text."""
    grasps = copied(grasps_at_hand(10), n_objects)
    trained, taught = timed(partial(train, grasps, DEFAULT_TRAINER))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "model.npz"
        pads = grasps[0].pads
        save_model(path, trained.recognizer, trainer_name=DEFAULT_TRAINER, pads=pads)
        n_bytes = path.stat().st_size
    some = grasps[:: max(1, len(grasps) // n_answers)]
    took = [timed(partial(trained.recognizer.posterior, grasp))[1] for grasp in some][1:]
    p50_ms, p99_ms = (1e3 * quantile([one.cpu_s for one in took], p) for p in (0.5, 0.99))
    return (
        f"{len(grasps)} grasps taught in {taught.wall_s:.1f} s (CPU {taught.cpu_s:.1f} s), "
        f"model {1e-6 * n_bytes:.1f} MB, an answer {p50_ms:.1f} ms CPU, "
        f"p99 {p99_ms:.1f} ms"
    )


def main(effort: float = 1.0) -> None:
    line("compared", "numbers of objects")
    n_answers = repeats(_ANSWERS, effort, least=20)
    for n_objects in [n for n in _OBJECTS if n <= max(_OBJECTS[0], effort * _OBJECTS[-1])]:
        text, _, (peak_gb, _) = in_own_process(partial(cost, n_objects, n_answers))
        line(f"{n_objects} objects", f"{text}, {peak_gb:.2f} GB")
