"""Algorithm 1's sweep over the printed grid against plain loops over ``numpy.linalg.eigvalsh``.

The grid has 21,607 matrices an object, and there are the paper's five objects. The plain way is
three nested loops that build, invert, apply and decompose one 4x4 matrix at a time; ours is
`recognition.trajectory.sweep`. Both take turns, and every value is compared.
"""

import statistics
import time
from dataclasses import dataclass, replace

import numpy as np

from benchmarks._measure import in_turns, line, ratio, repeats, same, timed
from recognition.trajectory import PAPER_SWEEP, SweepSettings, sweep

# oval, cylinder (closed by a large ellipsoid: an exact one has no level), box, ball, dumbbell; mm
_SEMI_AXES_MM = ((7.0, 7.0, 5.85), (3.0, 3.0, 100.0), (5.0, 7.95, 5.0), (4.75, 4.75, 4.75))
OBJECTS = np.array(
    [np.diag([*(1 / np.square(axes)), -1.0]) for axes in _SEMI_AXES_MM]
    + [np.diag([1 / 25.0, 1 / 25.0, -1 / 6.5**2, -1.0])]
)
_TOLERANCE = 1e-9


@dataclass(frozen=True, slots=True, kw_only=True)
class Run:
    """One sweep over all objects: its values, its time and the part of it in the solver, in s."""

    values: np.ndarray
    wall_s: float
    solver_s: float = float("nan")


def plain_matrix(scale: float, shift: float, angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    about_x = np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
    about_y = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    about_z = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    M = np.eye(4)
    M[:3, :3] = scale * (about_z @ about_y @ about_x)
    M[:2, 3] = shift
    return M


def plain_loops(settings: SweepSettings) -> Run:
    values = np.empty((len(OBJECTS), settings.n_evaluations))
    solver_s = 0.0
    begin_s = time.perf_counter()
    for index, Q in enumerate(OBJECTS):
        i = 0
        for scale in settings.scale:
            for shift in settings.translation:
                for angle in settings.angle_rad:
                    inverse = np.linalg.inv(plain_matrix(scale, shift, angle))
                    moved = inverse.T @ Q @ inverse
                    start_s = time.perf_counter()
                    eigenvalues = np.linalg.eigvalsh(moved)
                    solver_s += time.perf_counter() - start_s
                    values[index, i] = np.abs(eigenvalues).min()
                    i += 1
    return Run(values=values, wall_s=time.perf_counter() - begin_s, solver_s=solver_s)


def our_sweep(settings: SweepSettings) -> Run:
    found: list[np.ndarray] = []
    wall_s = timed(lambda: found.append(sweep(OBJECTS, settings).value)).wall_s
    return Run(values=found[0], wall_s=wall_s)


def main(effort: float = 1.0) -> None:
    rounds = repeats(3, effort)
    settings = PAPER_SWEEP
    if effort < 1.0:
        settings = replace(PAPER_SWEEP, scale=PAPER_SWEEP.scale[::10])
    runs = in_turns(
        {"plain": lambda: plain_loops(settings), "sweep": lambda: our_sweep(settings)}, rounds
    )
    plain, ours = runs["plain"], runs["sweep"]
    difference = max(
        float(np.max(np.abs(b.values / a.values - 1.0))) for a, b in zip(plain, ours, strict=True)
    )
    same(difference < _TOLERANCE, f"the values differ by up to {difference:.1e} of themselves")

    n = plain[0].values.size
    plain_s, solver_s, ours_s = (
        statistics.median(times)
        for times in (
            [run.wall_s for run in plain],
            [run.solver_s for run in plain],
            [run.wall_s for run in ours],
        )
    )
    line("compared", f"{n} matrices, {rounds} rounds in turns, equal to {difference:.1e}")
    line("  plain loops", f"{plain_s:.3f} s (eigvalsh alone {solver_s:.3f} s)")
    line("  sweep", f"{ours_s:.3f} s, {1e9 * ours_s / n:.0f} ns a matrix")
    by_wall = ratio([run.wall_s for run in plain], [run.wall_s for run in ours])
    by_solver = ratio([run.solver_s for run in plain], [run.wall_s for run in ours])
    line("  ratio", f"sweep is {by_wall:.1f} times as fast ({by_solver:.1f} as eigvalsh alone)")


if __name__ == "__main__":
    main()
