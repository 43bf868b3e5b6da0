"""The full product of Algorithm 1's loops, 256,021,343 poses an object, against eigvalsh.

Ours is `benchmarks.paper.sweep_full.sweep_summary`: extremes and histogram of all poses. What
``numpy.linalg.eigvalsh`` would take over all of them is scaled up from batches of a sub-grid, whose
matrices are made before and not timed. On a sub-grid every pose is also run by brute force: the
extremes must agree to 1e-9 of themselves and the histograms must be equal. Times are CPU times.
"""

import resource
from dataclasses import replace

import numpy as np

from benchmarks._measure import line, repeats, same, timed
from benchmarks.paper.sweep import OBJECTS
from benchmarks.paper.sweep_full import FULL_PRODUCT, sweep_summary
from recognition.quadric.quadric import height_field_matrix, rotation_xyz, translation
from recognition.quadric.trajectory import PAPER_SWEEP, SweepSettings

NAMES = ("oval", "cylinder", "box", "ball", "dumbbell", "tilted cap in counts", "any matrix")
_EDGES = np.geomspace(1e-6, 1e2, 161)
_BATCH = 100_000
_TOLERANCE = 1e-9


def objects() -> np.ndarray:
    """Return the five objects, a height field in the form (7), and a matrix without symmetry."""
    cap = height_field_matrix(a=-4.0, b=-3.0, d=0.5, g=1.0, h=2.0, k=100.0)
    any_ = np.random.default_rng(0).normal(size=(4, 4))
    return np.array([*OBJECTS, cap, any_ + any_.T])


def brute_matrices(Q: np.ndarray, settings: SweepSettings) -> np.ndarray:
    """Return the matrices of all poses, M = T R S, each formed in full: (n, 4, 4)."""
    x, y = np.meshgrid(settings.translation, settings.translation, indexing="ij")
    shift = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    angles = np.stack(np.meshgrid(*[settings.angle_rad] * 3, indexing="ij"), axis=-1)
    M = translation(shift)[:, None] @ rotation_xyz(angles.reshape(-1, 3))
    M = np.repeat(M.reshape(1, -1, 4, 4), len(settings.scale), axis=0)
    M[..., :3, :3] *= settings.scale[:, None, None, None]
    inverse = np.linalg.inv(M.reshape(-1, 4, 4))
    return np.swapaxes(inverse, -1, -2) @ Q @ inverse


def away_from(values: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Move edges that stand on a value, where rounding decides the bin, off it."""
    near = np.min(np.abs(np.log(edges[:, None] / np.unique(values)[None])), axis=1) < _TOLERANCE
    return np.where(near, edges * (1.0 + 3.0 * _TOLERANCE), edges)


def check_by_brute_force(settings: SweepSettings) -> int:
    """Compare extremes and histogram of every object with eigvalsh over all poses."""
    n = 0
    for name, Q in zip(NAMES, objects(), strict=True):
        values = np.abs(np.linalg.eigvalsh(brute_matrices(Q, settings))).min(axis=1)
        edges = away_from(values, np.geomspace(values.min() / 2, values.max() * 2, 41))
        found = sweep_summary(Q, edges, settings)
        same(
            np.array_equal(found.counts, np.histogram(values, edges)[0]),
            f"the histogram of the {name} is not that of eigvalsh",
        )
        for ours, theirs in ((found.least, values.min()), (found.greatest, values.max())):
            same(abs(ours / theirs - 1.0) < _TOLERANCE, f"the {name} has other extremes")
        n += len(values)
    return n


def main(effort: float = 1.0) -> None:
    small = replace(
        FULL_PRODUCT,
        scale=PAPER_SWEEP.scale[::15],
        translation=PAPER_SWEEP.translation[::10],
        angle_rad=PAPER_SWEEP.angle_rad[:: 2 if effort >= 1.0 else 4],
    )
    n_brute = check_by_brute_force(small)
    settings = FULL_PRODUCT
    if effort < 1.0:
        settings = replace(FULL_PRODUCT, translation=PAPER_SWEEP.translation[::4])
    batch = brute_matrices(OBJECTS[2], small)
    batch = np.concatenate([batch] * (1 + _BATCH // len(batch)))[:_BATCH]
    rounds = repeats(3, effort)
    line("compared", f"{settings.n_evaluations:,} poses an object, one thread")
    line("  brute force", f"{n_brute:,} poses: same extremes, same histograms")
    for name, Q in zip(NAMES, objects(), strict=True):
        eigvalsh_s, ours_s = [], []
        for _ in range(rounds):
            each_s = timed(lambda: np.linalg.eigvalsh(batch)).cpu_s / _BATCH
            eigvalsh_s.append(each_s * settings.n_evaluations)
            ours_s.append(timed(lambda one=Q: sweep_summary(one, _EDGES, settings)).cpu_s)
        found = sweep_summary(Q, _EDGES, settings)
        line(
            f"  {name}",
            f"{np.median(ours_s):.2f} s, eigvalsh {np.median(eigvalsh_s):.0f} s (scaled up); "
            f"{found.n_solved:,} solved, {found.n_fallback} by eigvalsh; "
            f"{found.least:.4g} to {found.greatest:.4g}",
        )
        line("  ratio", f"{np.median(np.divide(eigvalsh_s, ours_s)):.0f} times as fast")
    peak_mib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    line("  largest memory", f"{peak_mib:.0f} MiB of the whole process")


if __name__ == "__main__":
    main()
