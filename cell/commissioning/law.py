"""The law from counts to newtons: checked with weights or a kitchen scale, and set right."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from cell.checks.findings import Finding
from cell.commissioning.bench import Bench
from cell.commissioning.engine import Dialog, NumberRange, Question, Step, StepFailed
from cell.commissioning.figures import curves
from cell.commissioning.pads import sequence_forces_n
from cell.commissioning.unit import unit_sensor
from cell.config.tactile import LinearCalibrationConfig, TactileConfig
from tactile.sensor.sensor import TactileSensor

GRAVITY_N_KG = 9.80665
"""Standard acceleration of fall (ISO 80000-3): what a kitchen scale takes for its grams."""
_TYPED = "loads_so_far_n"
"""Name of the loads by finger among the values, until all of them are there."""
_STEPS = 3
"""Loads on each inner pad."""
_LOAD_FRAMES = 25
"""Frames whose mean is a load: half a second."""
_WATCH_FRAMES = 4
"""Frames between two values on the screen."""
_RIGHT_SHARE = 0.05
"""Deviation of the factor from 1 up to which the law is right: a kitchen scale that a hand holds
wavers by 2 %, the simulated cell has shown up to 3 %."""
_RESIDUAL_SHARE = 0.12
"""Root of the mean squared residual over the largest load from which it is no factor that is
wrong."""
_FINGERS_APART = 0.12
"""Difference of the factors of both pads from which one factor for both is worth a word."""
_LEAST_LOAD_N = 0.2
"""Smallest load in N that counts: of less the noise is a tenth."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Factor:
    """Straight line through the origin from the forces shown to the true ones."""

    factor: float
    """True force over the force shown."""
    residual_n: float
    """Root of the mean squared residual in N."""
    residual_share: float
    """The same over the largest true force."""


def fit_factor(true_n: ArrayLike, shown_n: ArrayLike) -> Factor:
    """Return the factor that brings the forces shown nearest to the true ones.

    Both are forces in N, (n,) float64. Raises ValueError if nothing is shown, or there is no load.
    """
    true = np.asarray(true_n, dtype=np.float64)
    shown = np.asarray(shown_n, dtype=np.float64)
    if true.shape != shown.shape or not true.size:
        raise ValueError(f"{true.size} loads and {shown.size} forces shown")
    power = float(shown @ shown)
    if not power > 0.0 or not true.max() > 0.0:
        raise ValueError("the pads show no force under these loads")
    factor = float(true @ shown) / power
    residual_n = float(np.sqrt(np.mean((true - factor * shown) ** 2)))
    return Factor(
        factor=factor, residual_n=residual_n, residual_share=residual_n / float(true.max())
    )


class LawStep(Step):
    """Has each inner pad loaded three times, and sets the factor of the law."""

    key = "pads_law"
    title = "Newtons of the pads"
    purpose = (
        "You load each inner pad three times with a weight or against a kitchen scale and type "
        "its reading in grams: the law from counts to newtons is checked, and its factor set. "
        "Nothing moves."
    )
    needs = ("pads_pressed",)
    needs_pads = True
    undo = "nothing to undo: it is a setting of the config (tactile.calibration)"

    def run(self, bench: Bench, dialog: Dialog, notes: Finding) -> None:
        """Ask for the loads, and judge them."""
        answer = dialog.choose(
            "pads_law.with",
            "Do you have weights of up to a kilogram, or a kitchen scale? Nothing may touch "
            "the pads while you answer: their zero is taken next.",
            {"scale": "yes", "skip": "no: forces stay unchecked"},
            "scale",
        )
        if answer == "skip":
            notes.warn(
                "The forces of the pads were not checked: they may be wrong by a fifth and more. "
                "Run this step again with a kitchen scale before parts that can break."
            )
            return
        dialog.say(
            "Lay a flat stamp of about 10 mm across on the middle of the pad. Press it against the "
            "scale, or lay the weight on it, and keep it so until the next question."
        )
        # Loads of a run that did not come to its end; an error of the unit cost them otherwise.
        loads = [list(map(tuple, of)) for of in bench.found.get(self.key, {}).get(_TYPED, ([], []))]
        if kept := sum(map(len, loads)):
            dialog.say(f"{kept} loads are kept from before.")
        notes.values[_TYPED] = loads
        with unit_sensor(bench) as sensor:
            sensor.tare(bench.tactile().tare_frames)
            for finger in (0, 1):
                _load(sensor, dialog, finger, _targets_n(bench), loads[finger])
        del notes.values[_TYPED]
        judge_law(bench.tactile(), loads, notes)


Load = tuple[float, float]
"""True force and force shown in N."""


def _targets_n(bench: Bench) -> list[float]:
    """Return the loads in N that are asked for: even steps over the forces of the sequence."""
    least_n, most_n = sequence_forces_n(bench)
    return [round(float(n), 1) for n in np.linspace(min(least_n, 0.5 * most_n), most_n, _STEPS)]


def _load(
    sensor: TactileSensor,
    dialog: Dialog,
    finger: int,
    targets_n: Sequence[float],
    loads: list[Load],
) -> None:
    """Add the true and shown forces of the loads on one inner pad to those that are there."""
    pad = sensor.layout.gripping_pads[finger]
    name = sensor.layout.pads[pad].name
    most_g = 2e3 * max(targets_n) / GRAVITY_N_KG
    for number, target_n in list(enumerate(targets_n, start=1))[len(loads) :]:
        answer = dialog.ask(
            Question(
                key=f"pads_law.{finger}.{number}",
                text=f"Load {number} of {len(targets_n)} on {name}: about "
                f"{1e3 * target_n / GRAVITY_N_KG:.0f} g. Type the reading while it lies there.",
                number=NumberRange(lowest=1.0, highest=round(most_g), unit="g"),
            ),
            watch=lambda: f"{name} shows {_shown_n(sensor, pad, _WATCH_FRAMES):.2f} N",
        )
        true_n = 1e-3 * float(answer) * GRAVITY_N_KG
        loads.append((true_n, _shown_n(sensor, pad, _LOAD_FRAMES)))
        dialog.say(f"{true_n:.2f} N on the scale, {loads[-1][1]:.2f} N by the pad.")
    dialog.say("Take the load off.")


def _shown_n(sensor: TactileSensor, pad: int, n_frames: int) -> float:
    """Return the force on a pad in N over the mean of some frames, of all its taxels.

    The sensor itself leaves out taxels that do not stand out of the noise of three frames.
    """
    counts = np.mean([sensor.read(timeout_s=1.0).tared_counts for _ in range(n_frames)], axis=0)
    return float(sensor.calibration.force_n(counts)[sensor.layout.taxels_of(pad)].sum())


def judge_law(tactile: TactileConfig, loads: Sequence[Sequence[Load]], notes: Finding) -> None:
    """Note what the loads on both inner pads say of the law, and set it right.

    ``tactile`` has the law by which the forces were shown; ``loads`` are the true force and the one
    shown in N of each load, by finger. Raises StepFailed where the loads show no law.
    """
    both = [load for of_finger in loads for load in of_finger if load[0] >= _LEAST_LOAD_N]
    true_n = sorted(true_n for true_n, _ in both)
    shown = {f"finger {n}": _at(sorted(loads[n]), true_n) for n in range(len(loads))}
    notes.figures["law"] = curves(
        "Force by the pads over that of the scale",
        true_n,
        shown | {"a pad that is right": true_n},
        x_label="scale / N",
        y_label="pads / N",
    )
    try:
        fits = [fit_factor(*zip(*of_finger, strict=True)) for of_finger in loads]
        fit = fit_factor(*zip(*both, strict=True))
    except (ValueError, TypeError) as error:
        raise StepFailed(
            f"No law can be found: {error}. Press on the middle of each pad."
        ) from error
    notes.values |= {
        "loads_n": [list(map(list, of_finger)) for of_finger in loads],
        "factor": fit.factor,
        "factors": [one.factor for one in fits],
        "residual_n": fit.residual_n,
    }
    notes.fact(
        f"{len(both)} loads up to {max(both)[0]:.1f} N: the pads show "
        f"{(1.0 / fit.factor - 1.0):+.0%} of the scale's force, residual {fit.residual_n:.2f} N."
    )
    if max(one.residual_share for one in fits) > _RESIDUAL_SHARE or not _rising(loads):
        raise StepFailed(
            "The loads do not lie on one law: was the stamp beside the pad, or moved it? Load the "
            "middle of the pad again; where it stays so, the pads need another calibration "
            "(tactile.calibration.kind)."
        )
    if abs(fits[0].factor - fits[1].factor) / fit.factor > _FINGERS_APART:
        notes.warn(
            f"The pads differ: factor {fits[0].factor:.2f} on finger 0, {fits[1].factor:.2f} on "
            "finger 1; one factor is set for both. Check whether both have the same foam."
        )
    if abs(fit.factor - 1.0) > _RIGHT_SHARE:
        law = tactile.calibration
        linear = isinstance(law, LinearCalibrationConfig)
        key = f"tactile.calibration.{'force_per_count_n' if linear else 'gain'}"
        before = law.force_per_count_n if isinstance(law, LinearCalibrationConfig) else law.gain
        notes.settings[key] = round(before * fit.factor, 6)
        notes.warn(
            f"The law was {abs(1.0 / fit.factor - 1.0):.0%} off: {key} was {before:g}, is now "
            f"{before * fit.factor:.3g}",
            corrected=True,
        )


def _rising(loads: Sequence[Sequence[Load]]) -> bool:
    """Return whether more load always shows more force."""
    return all(
        more[1] > less[1]
        for of_finger in loads
        for less, more in pairwise(sorted(of_finger))
        if more[0] > 1.1 * less[0]
    )


def _at(loads: Sequence[Load], places_n: Sequence[float]) -> list[float]:
    """Return the forces shown at some true forces, between the loads by straight lines."""
    true_n, shown_n = zip(*loads, strict=True) if loads else ((0.0,), (0.0,))
    return [float(v) for v in np.interp(places_n, true_n, shown_n, left=np.nan, right=np.nan)]
