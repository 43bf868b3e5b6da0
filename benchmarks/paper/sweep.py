"""Algorithm 1's sweep over the printed grid against ``numpy.linalg.eigvalsh``.

The grid has 21,607 matrices an object, and there are the paper's five objects. The plain way is
three nested loops that build, invert, apply and decompose one 4x4 matrix at a time. The batched way
is one call of eigvalsh over all the matrices, which are made before and not timed. Ours is
`recognition.quadric.trajectory.sweep`, from the five matrices to all values. They take turns, every
value is compared, and a sample is held against 50 digits. Times are those of the CPU: all run in
one thread, and what else the machine does is not counted.
"""

import statistics
import time
from dataclasses import dataclass, replace

import mpmath
import numpy as np

from benchmarks._measure import in_turns, line, ratio, repeats, same, timed
from recognition.quadric.trajectory import PAPER_SWEEP, SweepSettings, sweep

# oval, cylinder (closed by a large ellipsoid: an exact one has no level), box, ball, dumbbell; mm
_SEMI_AXES_MM = ((7.0, 7.0, 5.85), (3.0, 3.0, 100.0), (5.0, 7.95, 5.0), (4.75, 4.75, 4.75))
OBJECTS = np.array(
    [np.diag([*(1 / np.square(axes)), -1.0]) for axes in _SEMI_AXES_MM]
    + [np.diag([1 / 25.0, 1 / 25.0, -1 / 6.5**2, -1.0])]
)
_TOLERANCE = 1e-9


@dataclass(frozen=True, slots=True, kw_only=True)
class Run:
    """One sweep over all objects: its values, its CPU time and the solver's part of it, in s."""

    values: np.ndarray
    cpu_s: float
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
    begin_s = time.process_time()
    for index, Q in enumerate(OBJECTS):
        i = 0
        for scale in settings.scale:
            for shift in settings.translation:
                for angle in settings.angle_rad:
                    inverse = np.linalg.inv(plain_matrix(scale, shift, angle))
                    moved = inverse.T @ Q @ inverse
                    start_s = time.process_time()
                    eigenvalues = np.linalg.eigvalsh(moved)
                    solver_s += time.process_time() - start_s
                    values[index, i] = np.abs(eigenvalues).min()
                    i += 1
    return Run(values=values, cpu_s=time.process_time() - begin_s, solver_s=solver_s)


def all_matrices(settings: SweepSettings) -> np.ndarray:
    """Return the matrices of the plain loops, (n_objects * n_evaluations, 4, 4)."""
    grid = [
        plain_matrix(scale, shift, angle)
        for scale in settings.scale
        for shift in settings.translation
        for angle in settings.angle_rad
    ]
    inverse = np.linalg.inv(np.array(grid))
    moved = np.swapaxes(inverse, -1, -2) @ OBJECTS[:, None] @ inverse
    return moved.reshape(-1, 4, 4)


def batched(matrices: np.ndarray) -> Run:
    found: list[np.ndarray] = []
    cpu_s = timed(lambda: found.append(np.linalg.eigvalsh(matrices))).cpu_s
    return Run(values=np.abs(found[0]).min(axis=1).reshape(len(OBJECTS), -1), cpu_s=cpu_s)


def our_sweep(settings: SweepSettings) -> Run:
    found: list[np.ndarray] = []
    cpu_s = timed(lambda: found.append(sweep(OBJECTS, settings).value)).cpu_s
    return Run(values=found[0], cpu_s=cpu_s)


def precise(settings: SweepSettings, object_: int, index: int) -> float:
    """Return one value of the sweep from 50 digits, the pose being made of doubles."""
    shape = (len(settings.scale), len(settings.translation), len(settings.angle_rad))
    i, j, k = np.unravel_index(index, shape)
    scale, shift, angle = settings.scale[i], settings.translation[j], settings.angle_rad[k]
    with mpmath.workdps(50):
        c, s = mpmath.cos(mpmath.mpf(angle)), mpmath.sin(mpmath.mpf(angle))
        about_x = mpmath.matrix([[1, 0, 0], [0, c, -s], [0, s, c]])
        about_y = mpmath.matrix([[c, 0, s], [0, 1, 0], [-s, 0, c]])
        about_z = mpmath.matrix([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        M = mpmath.eye(4)
        M[:3, :3] = mpmath.mpf(scale) * (about_z * about_y * about_x)
        M[0, 3] = M[1, 3] = mpmath.mpf(shift)
        inverse = M**-1
        moved = inverse.T * mpmath.matrix(OBJECTS[object_].tolist()) * inverse
        values = mpmath.eigsy(0.5 * (moved + moved.T), eigvals_only=True)
        return float(min(abs(value) for value in values))


def against_50_digits(settings: SweepSettings, runs: dict[str, Run], n: int) -> dict[str, float]:
    """Return the largest relative error of each way over n poses of every object."""
    rng = np.random.default_rng(1)
    worst = dict.fromkeys(runs, 0.0)
    for object_ in range(len(OBJECTS)):
        for index in rng.choice(settings.n_evaluations, n, replace=False):
            reference = precise(settings, object_, int(index))
            for name, run in runs.items():
                error = abs(run.values[object_, index] / reference - 1.0)
                worst[name] = max(worst[name], float(error))
    return worst


def main(effort: float = 1.0) -> None:
    rounds = repeats(5, effort)
    settings = PAPER_SWEEP
    if effort < 1.0:
        settings = replace(PAPER_SWEEP, scale=PAPER_SWEEP.scale[::10])
    matrices = all_matrices(settings)
    runs = in_turns(
        {
            "plain": lambda: plain_loops(settings),
            "batched": lambda: batched(matrices),
            "sweep": lambda: our_sweep(settings),
        },
        rounds,
    )
    difference = max(
        float(np.max(np.abs(run.values / runs["plain"][0].values - 1.0)))
        for run in (*runs["plain"], *runs["batched"], *runs["sweep"])
    )
    same(difference < _TOLERANCE, f"the values differ by up to {difference:.1e} of themselves")

    n = runs["plain"][0].values.size
    cpu_s = {name: [run.cpu_s for run in one] for name, one in runs.items()}
    middle_s = {name: statistics.median(times) for name, times in cpu_s.items()}
    solver_s = statistics.median(run.solver_s for run in runs["plain"])
    line("compared", f"{n} matrices, {rounds} rounds in turns, equal to {difference:.1e}")
    line("  plain loops", f"{middle_s['plain']:.3f} s (eigvalsh alone {solver_s:.3f} s)")
    line("  one eigvalsh call", f"{1e3 * middle_s['batched']:.1f} ms, matrices made before")
    each_ns = 1e9 * middle_s["sweep"] / n
    line("  sweep", f"{1e3 * middle_s['sweep']:.1f} ms, {each_ns:.0f} ns a matrix")
    worst = against_50_digits(
        settings, {name: one[0] for name, one in runs.items()}, repeats(200, effort)
    )
    text = ", ".join(f"{name} {error:.1e}" for name, error in worst.items())
    line("  error, 50 digits", f"at most {text}")
    by_plain = ratio(cpu_s["plain"], cpu_s["sweep"])
    by_batched = ratio(cpu_s["batched"], cpu_s["sweep"])
    line(
        "  ratio",
        f"sweep is {by_batched:.1f} times as fast as one eigvalsh call, {by_plain:.0f} as loops",
    )


if __name__ == "__main__":
    main()
