"""Identification of a servo's drive from what it does: pure functions, no clock and no bus.

Free motion shows friction in amperes, and with its voltages the back-EMF. Fingers that press on
each other, one locked by its friction and the other one moved slowly, show amperes for each N m.
Neither shows the motor constant and the gain of the pads apart: the back-EMF is the anchor.
"""

from collections.abc import Sequence
from dataclasses import replace
from math import exp, hypot, log
from typing import NamedTuple

import numpy as np

from gripper.dynamixel.drive import SIGMAS, DriveCharacteristic
from gripper.dynamixel.models import ServoModel

_SHAPES = ((2.5, 1.0), (2.5, 0.8), (2.0, 1.5), (2.5, 2.0), (2.9, 4.0), (2.9, 8.7), (1.0, 1.0))
"""Speeds in rad/s and exponents of Stribeck's term that are tried: those of the gearings that were
identified (arXiv 2410.08650), and between."""
_STRIBECK_SD, _VISCOUS_SD_S, _OFFSET_SD = 0.4, 0.15, 0.05
"""Standard deviations of Stribeck's term, of the viscous one for 1 rad/s and of the offset before
any of them was measured, as shares of the friction. [assumed]"""
_POINT_SD = 0.02
"""Error of the current of one free motion that its length does not lessen, as a share: teeth,
temperature, acceleration. [assumed]"""
LEAST_FRICTION_SD, _LEAST_LOAD_SD = 0.05, 0.02
"""Least uncertainty of a measured friction, which wanders from one motion to the next, and of
amperes for each N m. [assumed]"""
_CHANGE_SD = 0.1
"""Spread of the friction of one servo within a day, as a share: grease that warms. [assumed]"""
_BACK_EMF_SD = 0.1
"""Spread of the back-EMF over the motor constant within a model, as a share. [assumed]"""
_LEAST_LINE = 12
"""Fewest points of a line of current over load."""
_LEAST_SPAN = 1.5
"""Least ratio of the speeds that show resistance and back-EMF apart."""
_OUTLIER_SIGMAS = 2.5
"""Points farther from a line, in standard deviations, are left out once."""


class FreePoint(NamedTuple):
    """Steady free motion of one servo; all signs are those of the opening gripper."""

    speed_rad_s: float
    current_a: float
    sd_a: float
    """Standard deviation of the mean current in A."""
    voltage_v: float | None = None
    """Voltage that the servo has put on its motor; None: not known."""


class LoadPoint(NamedTuple):
    """Load in N m of a servo that presses, by the pads, and its current in A; both from 0 up."""

    load_nm: float
    current_a: float


def fit_friction(points: Sequence[FreePoint], before: DriveCharacteristic) -> DriveCharacteristic:
    """Return a characteristic with the friction that free motions show.

    Parameters
    ----------
    points
        Free motions; four speeds or more in both directions, one at 0.3 rad/s or slower, show
        all of it. What they leave open is as it was.
    before
        What was known, as a prior with its uncertainty.
    """
    if not points:
        return before
    scale_a = float(np.median([abs(point.current_a) for point in points]))
    if before.measured:
        spread_a = before.friction_sd * before.breakaway_a
        sds = (spread_a, spread_a, spread_a, _OFFSET_SD * scale_a)
        shapes: Sequence[tuple[float, float]] = ((before.stribeck_rad_s, before.stribeck_exponent),)
        if before.stribeck_a == 0.0:
            shapes = _SHAPES
        prior = (before.coulomb_a, before.stribeck_a, before.viscous_a_s, before.offset_a)
    else:
        sds = (
            10.0 * scale_a,
            *(share * scale_a for share in (_STRIBECK_SD, _VISCOUS_SD_S, _OFFSET_SD)),
        )
        prior, shapes = (scale_a, 0.0, 0.0, 0.0), _SHAPES
    speed = np.array([abs(point.speed_rad_s) for point in points])
    sign = np.array([1.0 if point.speed_rad_s > 0.0 else -1.0 for point in points])
    sd = np.array([hypot(point.sd_a, _POINT_SD * point.current_a) for point in points])
    current = np.array([point.current_a for point in points])
    best: tuple[float, tuple[float, float], np.ndarray, np.ndarray] | None = None
    for shape in shapes:
        slow = np.exp(-((speed / shape[0]) ** shape[1]))
        rows = np.column_stack([sign, sign * slow, sign * speed, np.ones(len(points))])
        whole = np.vstack([rows / sd[:, None], np.diag(1.0 / np.array(sds))])
        wanted = np.concatenate([current / sd, np.array(prior) / np.array(sds)])
        found = np.linalg.lstsq(whole, wanted, rcond=None)[0]
        misfit = float(((whole @ found - wanted) ** 2).sum())
        if best is None or misfit < best[0] - 1e-9:
            best = misfit, shape, found, np.linalg.inv(whole.T @ whole)
    assert best is not None
    _, shape, (coulomb, stribeck, viscous, offset), covariance = best
    rest_a = max(float(coulomb + stribeck), 0.1 * scale_a)
    rest_sd = float((covariance[:2, :2].sum()) ** 0.5) / rest_a
    rested_a = before.coulomb_a + before.stribeck_a
    return replace(
        before,
        coulomb_a=rest_a - float(stribeck),
        stribeck_a=float(stribeck),
        viscous_a_s=float(viscous),
        stribeck_rad_s=shape[0],
        stribeck_exponent=shape[1],
        offset_a=float(offset),
        breakaway_a=before.breakaway_a * rest_a / rested_a if before.measured else rest_a,
        friction_sd=max(rest_sd, LEAST_FRICTION_SD),
    )


def fit_load(
    rising: Sequence[LoadPoint], falling: Sequence[LoadPoint], before: DriveCharacteristic
) -> DriveCharacteristic:
    """Return a characteristic with amperes for each N m, and with the breakaway.

    Points must be those of a servo that moves: it alone, slowly, while the other one stands. A
    direction with too few of them stays as it was.
    """
    up, down = _line(rising), _line(falling)
    values = before
    if up is not None:
        slope, base_a, slope_sd, base_sd = up
        ratio = slope / before.rising_a_nm
        friction_a = _weighed(
            (before.breakaway_a, before.friction_sd * before.breakaway_a),
            (base_a, max(base_sd, LEAST_FRICTION_SD * abs(base_a))),
        )
        values = replace(
            values,
            rising_a_nm=slope,
            falling_a_nm=before.falling_a_nm * ratio,
            breakaway_a=max(friction_a, 0.1 * before.breakaway_a),
            load_sd=max(slope_sd / slope, _LEAST_LOAD_SD),
        )
    if up is not None and down is not None and down[0] < up[0] * exp(SIGMAS * values.load_sd):
        values = replace(values, falling_a_nm=min(down[0], up[0]))
    return values


def fit_back_emf(points: Sequence[FreePoint]) -> float | None:
    """Return the back-EMF of free motions in V for each rad/s; None where they do not show it.

    The voltage on the motor is that of its winding, R i, and the back-EMF.
    """
    known = [point for point in points if point.voltage_v is not None]
    speeds = [abs(point.speed_rad_s) for point in known]
    if len(known) < 3 or max(speeds) < _LEAST_SPAN * min(speeds):
        return None
    rows = np.array([(point.current_a, point.speed_rad_s) for point in known])
    volts = np.array([point.voltage_v for point in known])
    found = np.linalg.lstsq(rows, volts, rcond=None)[0]
    return float(found[1]) if min(found) > 0.0 else None


def anchored(
    drive: DriveCharacteristic, model: ServoModel, back_emf_v_s: float
) -> DriveCharacteristic:
    """Return a characteristic whose motor constant follows the back-EMF, and no pad.

    A magnet that is weaker makes less torque and less back-EMF, in the same share.
    """
    resistance_ohm = model.nominal_voltage_v / model.stall_current_a
    idle_v = resistance_ohm * model.friction_nm / model.kt_nm_a
    expected_v_s = (model.nominal_voltage_v - idle_v) / model.no_load_rad_s
    return replace(
        drive,
        kt_nm_a=model.kt_nm_a * back_emf_v_s / expected_v_s,
        kt_sd=min(drive.kt_sd, _BACK_EMF_SD),
        back_emf_v_s=back_emf_v_s,
    )


def change(point: FreePoint, drive: DriveCharacteristic) -> float:
    """Return the friction of a free motion over the expected one where that is implausible, else 1.

    Only a measured friction can be contradicted.
    """
    sign = 1.0 if point.speed_rad_s > 0.0 else -1.0
    found_a = sign * (point.current_a - drive.offset_a)
    ratio = max(found_a, 1e-3 * drive.breakaway_a) / drive.friction_a(point.speed_rad_s)
    allowed = SIGMAS * hypot(drive.friction_sd, _CHANGE_SD, point.sd_a / abs(point.current_a))
    return ratio if drive.measured and abs(log(ratio)) > allowed else 1.0


def _weighed(first: tuple[float, float], second: tuple[float, float]) -> float:
    """Return the mean of two values, each with its standard deviation."""
    weights = [sd**-2 for _, sd in (first, second)]
    return (first[0] * weights[0] + second[0] * weights[1]) / sum(weights)


def _line(points: Sequence[LoadPoint]) -> tuple[float, float, float, float] | None:
    """Return slope and intercept of current over load, and their uncertainties; None: no line."""
    if len(points) < _LEAST_LINE:
        return None
    load, current = np.array(points).T
    keep = np.ones(len(points), dtype=bool)
    for _ in range(2):
        rows = np.column_stack([load[keep], np.ones(keep.sum())])
        found = np.linalg.lstsq(rows, current[keep], rcond=None)[0]
        off = current - (found[0] * load + found[1])
        sd = max(float(off[keep].std()), 1e-9)
        last, keep = keep, np.abs(off) <= _OUTLIER_SIGMAS * sd
        if keep.sum() < _LEAST_LINE:
            keep = last
    # Neighbouring points share their errors: the pads' mean and the current's filter.
    independent = max(2.0, rows.shape[0] / 4.0)
    inverse = np.linalg.pinv(rows.T @ rows) * rows.shape[0] / independent
    if found[0] <= 0.0:
        return None
    return (
        float(found[0]),
        float(found[1]),
        sd * float(inverse[0, 0]) ** 0.5,
        sd * float(inverse[1, 1]) ** 0.5,
    )
