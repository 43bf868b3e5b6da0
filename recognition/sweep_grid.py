"""The poses of Algorithm 1 as rotated translations, each distinct one once.

A pose enters the eigenvalues by its scale and by u alone (`recognition.sweep_arrow`): u = R^T t
where the rotation comes before the translation, u = t where it does not. Many poses share one u:
the loops run over a full turn with both ends, Euler angles name each rotation twice, translations
along x and y by a square grid are carried into themselves by quarter turns about z.
"""

from collections.abc import Iterator
from itertools import product

import numpy as np
from numpy.typing import NDArray

from recognition.sweep_arrow import Array
from recognition.transform import rotation_x, rotation_xyz, rotation_y, rotation_z

_STEP = 2.0**-45
"""Coordinates that agree to this part of the largest are one: far below any step of a grid, and
above the rounding of two ways to the same place."""

_CHUNK = 1 << 18  # rotated translations in memory at a time


def points(values: Array, n_axes: int, *, separate: bool) -> Array:
    """Return a loop's points, (n, n_axes): its value on all axes, or a loop for each axis."""
    if separate:
        return np.array(list(product(values, repeat=n_axes)))
    return np.repeat(values[:, None], n_axes, axis=1)


def rotates_translation(order: str) -> bool:
    """Return whether the rotation is undone before the translation: u = R^T t."""
    return order.index("T") < order.index("R")


def scales_translation(order: str) -> bool:
    """Return whether the translation is scaled along: u = s R^T t or u = s t."""
    return order.index("S") < order.index("T")


def in_printed_order(shift: Array, angle_rad: Array, *, rotated: bool) -> Array:
    """Return u of every translation (n, 2) and, innermost, every rotation (n, 3): (n, 3)."""
    shift = np.concatenate([shift, np.zeros((len(shift), 1))], axis=1)
    if not rotated:
        return np.repeat(shift, len(angle_rad), axis=0)
    R = rotation_xyz(angle_rad)[:, :3, :3]
    u: Array = np.einsum("rij,ti->trj", R, shift).reshape(-1, 3)
    return u


def weighted_chunks(
    shift: Array, angle_rad: Array, *, rotated: bool, separate: bool
) -> Iterator[tuple[Array, NDArray[np.int64]]]:
    """Yield rotated translations (n, 3) with the number of poses that each stands for.

    All poses are counted once over all chunks. ``angle_rad`` is (n,), the values of the loop;
    ``separate`` says whether each axis has a loop of its own.
    """
    plane = np.concatenate([shift, np.zeros((len(shift), 1))], axis=1)
    if not rotated:
        n_turns = len(angle_rad) ** (3 if separate else 1)
        yield plane, np.full(len(plane), n_turns)
        return
    if separate:
        # R = Rz Ry Rx: first all that z does within the plane, then y and x
        about_z = rotation_z(angle_rad)[:, :3, :3]
        plane = np.einsum("rij,ti->rtj", about_z, plane).reshape(-1, 3)
        after = rotation_y(angle_rad)[:, None, :3, :3] @ rotation_x(angle_rad)[None, :, :3, :3]
        after = after.reshape(-1, 3, 3)
    else:
        after = rotation_xyz(points(angle_rad, 3, separate=False))[:, :3, :3]
    first, n_first = distinct(plane.T)
    plane = plane[first]
    second, n_second = distinct(after.reshape(-1, 9).T)
    # rotations that differ in signs give the same u, or the same squares: keep them together
    rounded = np.round(np.abs(after[second].reshape(-1, 9)), 9)
    order = np.lexsort(rounded.T)
    after, n_second = after[second][order], n_second[order]
    step = max(1, _CHUNK // len(plane))
    for start in range(0, len(after), step):
        part = slice(start, start + step)
        u = np.einsum("rij,ti->rtj", after[part], plane).reshape(-1, 3)
        yield u, np.outer(n_second[part], n_first).ravel()


def distinct(
    columns: Array, weight: NDArray[np.int64] | None = None
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return which of the columns (n_features, n) differ, and the weight that each gathers.

    Returns
    -------
    first : (n_distinct,) int64
        Index of one column of each group.
    gathered : (n_distinct,) int64
        Sum of the weights of its group; a column weighs 1 where ``weight`` is not given.
    """
    first, group = groups(columns)
    gathered = np.bincount(group, weights=weight, minlength=len(first))
    return first, np.rint(gathered).astype(np.int64)  # whole numbers below 2^53 are exact


def groups(columns: Array) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return one index of each group of equal columns, and the group of every column."""
    n = columns.shape[1]
    if not columns.shape[0]:
        return np.zeros(1, dtype=np.int64), np.zeros(n, dtype=np.int64)
    largest = np.abs(columns).max(axis=1, keepdims=True)
    unit = np.where(largest > 0, largest * _STEP, 1.0)
    keys = np.rint(columns / unit).astype(np.int64)
    # sorted by a mixture of the keys; groups are told by the keys themselves, so that two keys
    # with one mixture can split a group and never join two
    mixed = np.zeros(n, dtype=np.uint64)
    for key in keys:
        mixed = (mixed ^ key.view(np.uint64)) * np.uint64(0x9E3779B97F4A7C15)
        mixed ^= mixed >> np.uint64(29)
    order = np.argsort(mixed, kind="stable")
    sorted_keys = keys[:, order]
    new = np.ones(n, dtype=np.bool_)
    new[1:] = np.any(sorted_keys[:, 1:] != sorted_keys[:, :-1], axis=0)
    group = np.empty(n, dtype=np.int64)
    group[order] = np.cumsum(new) - 1
    return order[new], group
