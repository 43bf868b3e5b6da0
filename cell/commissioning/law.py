"""The law from counts to newtons: checked with weights or a kitchen scale, and corrected."""

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import nnls

from cell.commissioning.bench import Bench
from cell.commissioning.engine import Dialog, Step, StepFailed
from cell.commissioning.findings import Notes
from cell.commissioning.pads import sequence_forces_n
from cell.commissioning.unit import unit_sensor
from cell.config.tactile import LinearCalibrationConfig, TableCalibrationConfig, TactileConfig
from tactile.sensor.sensor import TactileSensor

GRAVITY_N_KG = 9.80665
"""Standard acceleration of free fall (ISO 80000-3), which a kitchen scale assumes for its grams."""
_TABLE_SHARES = (0.0, 0.0625, 0.125, 0.25, 0.375, 0.5, 0.625, 0.75, 0.875, 1.0)
"""Nodes of a table of counts and forces, as shares of the full scale."""
_STEPS = 3
"""Loads on each inner pad."""
_LOAD_FRAMES = 25
"""Frames whose mean is a load: half a second."""
_WATCH_FRAMES = 4
"""Frames between two values on the screen."""
_RIGHT_SHARE = 0.05
"""Largest deviation of the factor from 1 of a correct law: a kitchen scale held by hand varies by
2 %, the simulated cell by up to 3 %."""
_RESIDUAL_SHARE = 0.12
"""Root mean square residual over the largest load above which a factor cannot correct the law."""
_FINGERS_APART = 0.12
"""Least reported difference of the factors of both pads."""
_LEAST_LOAD_N = 0.2
"""Smallest load in N that counts: the noise is a tenth of smaller ones."""


class Factor(NamedTuple):
    """Straight line through the origin from the shown forces to the true ones."""

    factor: float
    """True force over shown force."""
    residual_n: float
    """Root of the mean squared residual in N."""
    residual_share: float
    """The same over the largest true force."""


def fit_factor(true_n: ArrayLike, measured_n: ArrayLike) -> Factor:
    """Return the factor that fits the shown forces best to the true ones.

    Both are forces in N, (n,) float64. Raises ValueError without shown forces or loads.
    """
    true = np.asarray(true_n, dtype=np.float64)
    measured = np.asarray(measured_n, dtype=np.float64)
    if true.shape != measured.shape or not true.size:
        raise ValueError(f"{true.size} loads and {measured.size} forces shown")
    power = float(measured @ measured)
    if not power > 0.0 or not true.max() > 0.0:
        raise ValueError("the pads show no force under these loads")
    factor = float(true @ measured) / power
    residual_n = float(np.sqrt(np.mean((true - factor * measured) ** 2)))
    return Factor(factor, residual_n, residual_n / float(true.max()))


def table_parts(tared_counts: ArrayLike, adc_max: int) -> list[float]:
    """Return the counts of a pad in each part of the full scale, summed over taxels.

    A law of straight lines over these parts gives the pad's force as their sum, each times its
    slope. ``tared_counts`` is (n,).
    """
    counts = np.asarray(tared_counts, dtype=np.float64)[:, np.newaxis]
    nodes = adc_max * np.array(_TABLE_SHARES)
    parts = np.clip(counts - nodes[:-1], 0.0, np.diff(nodes))
    # The first line continues below zero: noise averages out.
    parts[:, 0] = np.minimum(counts[:, 0], nodes[1])
    return [float(part) for part in parts.sum(axis=0)]


def fit_table(
    true_n: ArrayLike, parts: ArrayLike, adc_max: int
) -> tuple[list[float], list[float], float]:
    """Return counts and forces in N of the table that fits the loads, and its residual in N.

    A pressed taxel is less sensitive, so each line is at least as steep as the one before. The
    table ends with the last part that has counts of the loads. Raises ValueError if no table fits.

    Parameters
    ----------
    true_n
        (n,): loads in N.
    parts
        (n, n_parts): `table_parts` of each load.
    """
    loads, counted = np.asarray(true_n), np.asarray(parts)
    used = int(np.count_nonzero(counted.max(axis=0) > 0.0))
    if not used:
        raise ValueError("the loads show no counts")
    # Rising slopes are sums of non-negative steps.
    steps = np.cumsum(counted[:, :used][:, ::-1], axis=1)[:, ::-1]
    rises, _ = nnls(steps, loads)
    slopes = np.cumsum(rises)
    if not slopes[0] > 0.0:
        raise ValueError("the loads show no law that rises with the counts")
    nodes = adc_max * np.array(_TABLE_SHARES[: used + 1])
    force_n = np.cumsum(slopes * np.diff(nodes))
    residual_n = float(np.sqrt(np.mean((steps @ rises - loads) ** 2)))
    return np.round(nodes[1:], 1).tolist(), np.round(force_n, 5).tolist(), residual_n


def measure_law(bench: Bench, dialog: Dialog, notes: Notes) -> None:
    """Load each inner pad three times with a weight or against a kitchen scale.

    Type the reading in grams: the law from counts to newtons is checked, and its factor or a table
    set. Nothing moves.
    """
    answer = dialog.choose(
        "pads_law.with",
        "Do you have weights of up to a kilogram, or a kitchen scale? Nothing may touch the pads "
        "while you answer: their zero is taken next.",
        {"scale": "yes", "skip": "no: forces stay unchecked"},
        "scale",
    )
    if answer == "skip":
        notes.warn(
            "The forces of the pads were not checked: they may be wrong by a fifth and more. Run "
            "this step again with a kitchen scale before parts that can break."
        )
        return
    dialog.say(
        "Lay a flat stamp of about 10 mm across on the middle of the pad. Press it against the "
        "scale, or lay the weight on it, and keep it so until the next question."
    )
    with unit_sensor(bench) as sensor:
        sensor.tare(bench.tactile().tare_frames)
        loads = [_loads(sensor, dialog, finger, _targets_n(bench)) for finger in (0, 1)]
        adc_max = sensor.layout.adc_max
    judge_law(bench.tactile(), loads, notes, adc_max)


LAW = Step(measure_law, "pads_law", "Newtons of the pads", needs=("pads_pressed",))


Load = tuple[float, ...]
"""True force and force shown in N, and the parts of `table_parts`."""


def _targets_n(bench: Bench) -> list[float]:
    """Return the planned loads in N: even steps over the forces of the sequence."""
    least_n, most_n = sequence_forces_n(bench)
    return [round(float(n), 1) for n in np.linspace(min(least_n, 0.5 * most_n), most_n, _STEPS)]


def _loads(
    sensor: TactileSensor, dialog: Dialog, finger: int, targets_n: Sequence[float]
) -> list[Load]:
    """Return the true and shown forces of the loads on one inner pad."""
    loads = list[Load]()
    pad = sensor.layout.gripping_pads[finger]
    name = sensor.layout.pads[pad].name
    most_g = 2e3 * max(targets_n) / GRAVITY_N_KG
    for number, target_n in enumerate(targets_n, start=1):
        weight_g = dialog.number(
            f"pads_law.{finger}.{number}",
            f"Load {number} of {len(targets_n)} on {name}: about "
            f"{1e3 * target_n / GRAVITY_N_KG:.0f} g. Type the reading while it lies there.",
            (1.0, round(most_g), "g"),
            watch=lambda: (
                f"{name} shows {_force_n(sensor, pad, _counts(sensor, pad, _WATCH_FRAMES)):.2f} N"
            ),
        )
        true_n = 1e-3 * weight_g * GRAVITY_N_KG
        counts = _counts(sensor, pad, _LOAD_FRAMES)
        parts = table_parts(counts, sensor.layout.adc_max)
        loads.append((true_n, _force_n(sensor, pad, counts), *parts))
        dialog.say(f"{true_n:.2f} N on the scale, {loads[-1][1]:.2f} N by the pad.")
    dialog.say("Take the load off.")
    return loads


def _counts(sensor: TactileSensor, pad: int, n_frames: int) -> NDArray[np.float64]:
    """Return the tared counts of a pad's taxels, (n,), as the mean of some frames.

    The sensor itself omits taxels below the noise of three frames.
    """
    counts = np.mean([sensor.read(timeout_s=1.0).tared_counts for _ in range(n_frames)], axis=0)
    return np.asarray(counts[sensor.layout.taxels_of(pad)], dtype=np.float64)


def _force_n(sensor: TactileSensor, pad: int, counts: NDArray[np.float64]) -> float:
    """Return the force in N by the present law from the tared counts of a pad."""
    of_all = np.zeros(sensor.layout.n_taxels)
    taxels = sensor.layout.taxels_of(pad)
    of_all[taxels] = counts
    return float(sensor.calibration.force_n(of_all)[taxels].sum())


def judge_law(
    tactile: TactileConfig,
    loads: Sequence[Sequence[Load]],
    notes: Notes,
    adc_max: int = 0,
) -> None:
    """Judge the law by the loads on both inner pads, and correct it.

    ``tactile`` has the law of the shown forces; ``loads`` are the true and the shown force in N of
    each load, by finger. Raises StepFailed if the loads show no law.
    """
    both = [load for of_finger in loads for load in of_finger if load[0] >= _LEAST_LOAD_N]
    try:
        *fits, fit = (
            fit_factor([load[0] for load in one], [load[1] for load in one])
            for one in (*loads, both)
        )
    except ValueError as error:
        text = f"No law can be found: {error}. Press on the middle of each pad."
        raise StepFailed(text) from error
    notes.values |= {"loads_n": [[*map(list, one)] for one in loads], "factor": fit.factor}
    notes.fact(
        f"{len(both)} loads up to {max(both)[0]:.1f} N: the pads show "
        f"{(1.0 / fit.factor - 1.0):+.0%} of the scale's force, residual {fit.residual_n:.2f} N."
    )
    bent = max(one.residual_share for one in fits) > _RESIDUAL_SHARE
    differ = abs(fits[0].factor - fits[1].factor) / fit.factor > _FINGERS_APART
    gains = list(tactile.pad_gains)
    if differ:
        gains = [g * one.factor / fit.factor for g, one in zip(gains, fits, strict=True)]
    table = isinstance(tactile.calibration, TableCalibrationConfig)
    off = abs(fit.factor - 1.0) > _RIGHT_SHARE
    tabled = (bent or (table and (off or differ))) and _rising(loads)
    if tabled and _set_table(loads, gains, adc_max, notes):
        bent = off = False
    if bent or not _rising(loads):
        raise StepFailed(
            "The loads do not fit one law: load the middle of the pad again. If they still do not "
            "fit, the pads need another calibration (tactile.calibration.kind)."
        )
    if differ:
        notes.settings["tactile.pad_gains"] = [round(gain, 4) for gain in gains]
        notes.warn(
            f"The pads differ: factor {fits[0].factor:.2f} on finger 0, {fits[1].factor:.2f} on "
            "finger 1; set in tactile.pad_gains. Check whether both have the same foam.",
            corrected=True,
        )
    law = tactile.calibration
    if off and not isinstance(law, TableCalibrationConfig):
        key = "force_per_count_n" if isinstance(law, LinearCalibrationConfig) else "gain"
        before = float(getattr(law, key))
        notes.settings[f"tactile.calibration.{key}"] = round(before * fit.factor, 6)
        notes.warn(
            f"The law was {abs(1.0 / fit.factor - 1.0):.0%} off: tactile.calibration.{key} was "
            f"{before:g}, is now {before * fit.factor:.3g}",
            corrected=True,
        )


def _set_table(
    loads: Sequence[Sequence[Load]], gains: Sequence[float], adc_max: int, notes: Notes
) -> bool:
    """Set the table of the loads, and return whether they lie on it."""
    true_n = [load[0] / gain for one, gain in zip(loads, gains, strict=True) for load in one]
    parts = [load[2:] for one in loads for load in one]
    if not all(parts):
        return False
    try:
        counts, force_n, residual_n = fit_table(true_n, parts, adc_max)
    except ValueError:
        return False
    if residual_n > _RESIDUAL_SHARE * max(true_n):
        return False
    notes.settings["tactile.calibration"] = {"kind": "table", "counts": counts, "force_n": force_n}
    notes.values["table_residual_n"] = residual_n
    notes.warn(
        f"The law is a table of {len(counts)} lines now (tactile.calibration), residual "
        f"{residual_n:.2f} N.",
        corrected=True,
    )
    return True


def _rising(loads: Sequence[Sequence[Load]]) -> bool:
    """Return whether more load always shows more force."""
    return all(
        more[1] > less[1]
        for of_finger in loads
        for less, more in pairwise(sorted(of_finger))
        if more[0] > 1.1 * less[0]
    )
