"""Recordings of a fleet that drifts, in virtual time: each is a few grasps of a cell on a day."""

from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np

from cell.recording.recorder import Recorder
from cell.recording.schema import RESULT
from gripper.values.force_sensor import ForceSample
from gripper.values.state import GripperPhase
from recognition.grasp import Grasp, PadArray
from tactile.source import TactileFrame
from tests.fuzz.harness import Clock
from tests.values import make_cycle, make_state

PADS = PadArray.grid(6, 4, pitch_m=3e-3)
FIRST_DAY = datetime(2027, 1, 4, 8, tzinfo=UTC)
SIZES_MM = {"ball": 30.0, "box": 20.0, "pen": 12.0}
"""Objects and their sizes: a larger one presses more taxels."""


def ramp(
    label: str,
    rng: np.random.Generator,
    *,
    cell: str = "press 1",
    start_ms: int = 0,
    offset_mm: float = 0.0,
    gains: Sequence[float] = (1.0, 1.0),
) -> Grasp:
    """Return a grasp of an object of such a size: rest, then a force that rises to 5 N."""
    load = np.clip(np.arange(30) / 30 * 1.5 - 0.4, 0.0, 1.0)
    radius_mm = 0.3 * SIZES_MM[label] * rng.normal(1.0, 0.03)
    middle_m = rng.normal(0.0, 5e-4, 2)
    map_ = np.exp(-(((PADS.taxel_xy_m - middle_m) * 1e3 / radius_mm) ** 2).sum(axis=1))
    counts = 20.0 + 2000.0 * load[:, None] * map_ * np.asarray(gains)[PADS.taxel_pad]
    opening_mm = SIZES_MM[label] + offset_mm + rng.normal(0.0, 0.1) - 0.5 * load
    opening_mm += np.where(load == 0.0, 2.0, 0.0)
    return Grasp(
        pads=PADS,
        counts=np.clip(counts + rng.normal(0.0, 3.0, counts.shape), 0, 4095),
        t_s=0.02 * np.arange(30),
        aperture_m=1e-3 * opening_mm,
        force_n=5.0 * load,
        label=label,
        source=f"cell {cell}",
        start_ms=start_ms,
    )


def record(
    path: Path,
    grasps: Sequence[Grasp],
    *,
    cell: str = "press 1",
    answers: Sequence[str | None] = (),
    closing_a: float = 0.13,
    hold_a: float = 0.33,
    n_grasps: int = 1,
) -> None:
    """Write a recording of grasps; one with an answer is an identification of its label."""
    clock = Clock()
    path.parent.mkdir(parents=True, exist_ok=True)
    recorder = Recorder(path, clock, pads=grasps[0].pads, metadata={"cell": cell})
    for grasp, answer in zip(grasps, answers or [None] * len(grasps), strict=True):
        clock.now_s += 1.0
        for _ in range(20):
            clock.now_s += 0.01
            moving = make_state(clock.now_s, current_a=closing_a)
            recorder.cycle(make_cycle(clock.now_s, phase=GripperPhase.APPROACHING, state=moving))
        start_s = clock.now_s + 0.01
        for i in range(grasp.n_frames):
            clock.now_s = start_s + float(grasp.t_s[i])
            state = make_state(clock.now_s, current_a=hold_a, aperture_m=float(grasp.aperture_m[i]))
            force = ForceSample(t_s=clock.now_s, force_n=(5.0, 5.0))
            recorder.cycle(make_cycle(clock.now_s, state=state, force=force))
            counts = grasp.counts[i]
            recorder.frame(TactileFrame(t_s=clock.now_s, counter=i, status=0, counts=counts))
        values = {name: getattr(grasp, name) for name in Grasp.__dataclass_fields__}
        recorder.grasp(Grasp(**values | {"label": grasp.label if answer is None else ""}))
        if answer is not None:
            clock.now_s += 0.01
            chances = {"labels": sorted(SIZES_MM), "probabilities": [0.2, 0.7, 0.1]}
            recorder.now(
                RESULT,
                {"label": answer, "held": grasp.label, "probability": 0.7, "unknown": 0.1}
                | {"n_grasps": n_grasps, "drift_gain": 0.9, "drift_aperture_m": 1e-4, **chances}
                | {"grasp_answers": [{"probabilities": [0.2, 0.7, 0.1], "unknown": 0.1}]}
                | {"shape": {"kind": "sphere", "size_m": 0.03, "low_m": 0.029, "high_m": 0.031}},
            )
    recorder.close()


def record_fleet(folder: Path, *, n_days: int) -> None:
    """Write a recording of each of two cells on each day.

    Of press 2 each day the opening moves by 0.3 mm, pad 1 loses 5 % and the friction grows by 4 %;
    from the sixth day on it names boxes as balls. Press 1 stays as it is.
    """
    rng = np.random.default_rng(3)
    for day in range(n_days):
        for cell in ("press 1", "press 2"):
            aged = day if cell == "press 2" else 0
            grasps, answers = list[Grasp](), list[str | None]()
            for number in range(2 * len(SIZES_MM)):
                label = list(SIZES_MM)[number % len(SIZES_MM)]
                taken = FIRST_DAY + timedelta(days=day, minutes=number)
                grasps.append(
                    ramp(
                        label,
                        rng,
                        cell=cell,
                        start_ms=int(1e3 * taken.timestamp()),
                        offset_mm=0.3 * aged,
                        gains=(1.0, 0.95**aged),
                    )
                )
                wrong = label == "box" and aged >= 5
                answers.append(None if number % 2 else "ball" if wrong else label)
            record(
                folder / f"run-{day:02d}-{cell[-1]}" / "recording.mcap",
                grasps,
                cell=cell,
                answers=answers,
                closing_a=0.13 * 1.04**aged,
                hold_a=0.2 + 0.13 * 1.04**aged,
            )
