"""Identification of a servo's drive from its motion: pure functions, without clock and bus.

Free motion gives the friction in A. Fingers that press on each other give A for each N m: friction
locks one, the other one moves slowly.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from math import hypot, log
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from gripper.dynamixel.drive import SIGMAS, DriveCharacteristic

_VISCOUS_SD_S, _OFFSET_SD = 0.15, 0.05
"""Standard deviations before a measurement, as shares of the friction: of the viscous term for 1
rad/s, and of the offset. [assumed]"""
_POINT_SD = 0.02
"""Error of the current of one free motion that a longer motion does not reduce, as a share: teeth,
temperature, acceleration. [assumed]"""
_LEAST_FRICTION_SD, _LEAST_LOAD_SD = 0.05, 0.02
"""Least uncertainty of a measured friction, which varies between motions, and of A for each N m.
[assumed]"""
_CHANGE_SD = 0.1
"""Spread of the friction of one servo within a day, as a share: grease that warms. [assumed]"""
_BLOCKS, _LEAST_BLOCKS = 30, 6
"""Parts of the points of a load whose means are taken, and fewest of these in a line. [tuned]"""
_RISE_LOCKED, _FALL_LOCKED, _ENDS = 0.25, 0.15, 0.05
"""Shares of the load's way that are left out after a turn to a load that rises, or that falls, and
before the next turn. [tuned]"""
_ALIKE = 2.0
"""Factor for the common error of neighbouring parts' means, over their scatter. [tuned]"""
_YIELDING = (0.7, 0.4)
"""Yielding share of a gearing, falling over rising slope, and the uncertainty of both: 0.3 to 1 for
gearings that lose up to half of the motor's torque (arXiv 2410.08650)."""
_SUREST = 0.2
"""Largest uncertainty of a rising slope that counts, as a share: a gearing that sticks gives few
edges, but no catalogue has its losses. [tuned]"""
_OUTLIER_SIGMAS = 2.5
"""Points farther from a line, in standard deviations, are left out once."""

Array = NDArray[np.float64]


class FreePoint(NamedTuple):
    """Steady free motion of one servo; all signs are those of the opening gripper."""

    speed_rad_s: float
    current_a: float
    sd_a: float
    """Standard deviation of the mean current in A."""


class LoadPoint(NamedTuple):
    """Load in N m of a servo that presses, by the pads, and its current in A; both from 0 up."""

    load_nm: float
    current_a: float


def fit_friction(points: Sequence[FreePoint], before: DriveCharacteristic) -> DriveCharacteristic:
    """Return a characteristic with the friction of free motions.

    Parameters
    ----------
    points
        Free motions. Three speeds or more in both directions, one at 0.3 rad/s or slower, determine
        all terms. Undetermined terms stay as they were.
    before
        Earlier characteristic, a prior with its uncertainty.
    """
    if not points:
        return before
    scale_a = float(np.median([abs(point.current_a) for point in points]))
    if before.measured:
        spread_a = before.friction_sd * before.breakaway_a
        sds = np.array([spread_a, spread_a, _OFFSET_SD * scale_a])
        prior = np.array([before.coulomb_a, before.viscous_a_s, before.offset_a])
    else:
        sds = scale_a * np.array([10.0, _VISCOUS_SD_S, _OFFSET_SD])
        prior = np.array([scale_a, 0.0, 0.0])
    speed = np.array([point.speed_rad_s for point in points])
    current = np.array([point.current_a for point in points])
    sd = np.array([hypot(point.sd_a, _POINT_SD * point.current_a) for point in points])
    rows = np.column_stack([np.sign(speed), speed, np.ones(len(points))])
    whole = np.vstack([rows / sd[:, None], np.diag(1.0 / sds)])
    targets = np.concatenate([current / sd, prior / sds])
    coulomb, viscous, offset = np.linalg.lstsq(whole, targets, rcond=None)[0].tolist()
    rest_a = max(coulomb, 0.1 * scale_a)
    rest_sd = float(np.linalg.inv(whole.T @ whole)[0, 0] ** 0.5) / rest_a
    return replace(
        before,
        coulomb_a=rest_a,
        viscous_a_s=viscous,
        offset_a=offset,
        breakaway_a=before.breakaway_share * rest_a if before.measured else rest_a,
        friction_sd=max(rest_sd, _LEAST_FRICTION_SD),
    )


def fit_load(
    rising: Sequence[LoadPoint], falling: Sequence[LoadPoint], before: DriveCharacteristic
) -> DriveCharacteristic:
    """Return a characteristic with amperes for each N m, and with the breakaway.

    Points, in the order of time, must be those of a moving servo: it alone moves, slowly, while the
    other one stands. A direction with too little data stays as it was. The earlier friction is a
    prior with its uncertainty.
    """
    if (blocks := _moving(rising, _RISE_LOCKED, 1.0 - _ENDS)) is None:
        return before
    base_sd_a = before.breakaway_a * max(before.friction_sd, _LEAST_FRICTION_SD)
    start = np.array([before.rising_a_nm, before.breakaway_a])
    line, sds = _fit(blocks, _rising_a, start, [np.inf, base_sd_a])
    if sds[0] > _SUREST * line[0]:
        return before
    slope, base_a = line.tolist()
    fitted = replace(
        before,
        rising_a_nm=slope,
        falling_a_nm=slope * before.falling_a_nm / before.rising_a_nm,
        breakaway_a=max(base_a, 0.1 * before.breakaway_a),
        load_sd=max(float(sds[0]) / slope, _LEAST_LOAD_SD),
    )
    if (blocks := _moving(falling, _ENDS, 1.0 - _FALL_LOCKED)) is None:
        return fitted
    start = np.array([_YIELDING[0] * line[0], _YIELDING[0], line[1]])
    down, _ = _fit(blocks, _falling_a, start, [_YIELDING[1] * line[0], _YIELDING[1], sds[1]])
    falls, share, _ = down.tolist()
    # A gearing needs no more current to yield than to drive.
    return replace(fitted, falling_a_nm=min(falls, slope), yielding_share=min(share, 1.0))


def change(point: FreePoint, drive: DriveCharacteristic) -> float:
    """Return the friction of a free motion over the expected one if implausible, else 1.

    Only a measured friction can be contradicted.
    """
    sign = 1.0 if point.speed_rad_s > 0.0 else -1.0
    friction_a = sign * (point.current_a - drive.offset_a)
    ratio = max(friction_a, 1e-3 * drive.breakaway_a) / drive.friction_a(point.speed_rad_s)
    allowed = SIGMAS * hypot(drive.friction_sd, _CHANGE_SD, point.sd_a / abs(point.current_a))
    return ratio if drive.measured and abs(log(ratio)) > allowed else 1.0


def grown(point: FreePoint, drive: DriveCharacteristic) -> float:
    """Return the factor by which the friction has grown since it was fitted, by a newer motion.

    One step of a Kalman filter: the factor is 1 within the spread of a day, and the motion shows it
    with its own uncertainty. A current near 0 shows little.
    """
    expected_a = drive.friction_a(point.speed_rad_s)
    sign = 1.0 if point.speed_rad_s > 0.0 else -1.0
    ratio = max(0.0, sign * (point.current_a - drive.offset_a)) / expected_a
    share = _CHANGE_SD**2 / (_CHANGE_SD**2 + (point.sd_a / expected_a) ** 2)
    return 1.0 + share * (ratio - 1.0)


def _rising_a(values: Array, load_nm: Array) -> Array:
    """Return currents of rising loads; ``values``: A for each N m, and A without a load."""
    slope, base_a = values
    current_a: Array = slope * load_nm + base_a
    return current_a


def _falling_a(values: Array, load_nm: Array) -> Array:
    """Return currents of falling loads; ``values``: A for each N m, yielding share, A at 0."""
    slope, share, base_a = values
    passive_nm = share * base_a / slope
    above_nm = load_nm - passive_nm
    current_a: Array = above_nm * np.where(above_nm > 0.0, slope, base_a / passive_nm)
    return current_a


def _moving(points: Sequence[LoadPoint], least: float, most: float) -> Array | None:
    """Return means (m, 2) of parts of the points, within shares of the load's way; None: too few.

    The noise of single loads would make a line too flat.
    """
    size = max(1, len(points) // _BLOCKS)
    n_blocks = len(points) // size
    if n_blocks < _LEAST_BLOCKS:
        return None
    blocks = np.array(points[: n_blocks * size]).reshape(n_blocks, size, 2).mean(axis=1)
    low, high = blocks[:, 0].min(), blocks[:, 0].max()
    # After a turn of the direction, friction locks the finger.
    way = (blocks[:, 0] - low) / max(high - low, 1e-9)
    moving: Array = blocks[(way >= least) & (way <= most)]
    return moving if len(moving) >= _LEAST_BLOCKS else None


def _fit(
    blocks: Array, model: Callable[[Array, Array], Array], start: Array, start_sds: Sequence[float]
) -> tuple[Array, Array]:
    """Fit a model of current over load; return its values and their standard deviations.

    Blocks far from it are left out.

    Parameters
    ----------
    blocks : (m, 2)
        Loads in N m and currents in A.
    model
        Currents of some values at some loads.
    start, start_sds
        Values before the measurement, and their standard deviations.
    """
    (load_nm, current_a), sd_a = blocks.T, start_sds[-1]

    def misfit(values: Array, load_nm: Array, current_a: Array, sd_a: float) -> Array:
        off = (model(values, load_nm) - current_a) / sd_a
        return np.concatenate([off, (values - start) / start_sds])

    limits = (1e-3 * start, np.inf)
    for _ in range(3):
        data = load_nm, current_a, sd_a
        fitted = least_squares(misfit, start, bounds=limits, x_scale=start, args=data)
        off_a = np.abs(model(fitted.x, load_nm) - current_a)
        sd_a = max(_ALIKE * float(np.median(off_a)) / 0.6745, 1e-4)
        near = off_a <= _OUTLIER_SIGMAS * sd_a / _ALIKE
        load_nm, current_a = load_nm[near], current_a[near]
    return fitted.x, np.sqrt(np.diag(np.linalg.pinv(fitted.jac.T @ fitted.jac)))
