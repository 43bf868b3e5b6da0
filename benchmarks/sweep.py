"""Time Algorithm 1's sweep against plain loops over ``numpy.linalg.eigvalsh``.

    python benchmarks/sweep.py [--repeats 3]

Runs the printed grid, 21,607 matrices an object, for the paper's five objects: once with three
nested loops that build, invert, apply and decompose one 4x4 matrix at a time, once with
`recognition.trajectory.sweep`, and compares every value.
"""

import argparse
import time

import numpy as np

from recognition.trajectory import PAPER_SWEEP, sweep

# oval, cylinder (closed by a large ellipsoid: an exact one has no level), box, ball, dumbbell; mm
SEMI_AXES_MM = ((7.0, 7.0, 5.85), (3.0, 3.0, 100.0), (5.0, 7.95, 5.0), (4.75, 4.75, 4.75))
OBJECTS = np.array(
    [np.diag([*(1 / np.square(axes)), -1.0]) for axes in SEMI_AXES_MM]
    + [np.diag([1 / 25.0, 1 / 25.0, -1 / 6.5**2, -1.0])]
)


def plain_matrix(scale, shift, angle):
    c, s = np.cos(angle), np.sin(angle)
    about_x = np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
    about_y = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    about_z = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    M = np.eye(4)
    M[:3, :3] = scale * (about_z @ about_y @ about_x)
    M[:2, 3] = shift
    return M


def plain_loops(objects):
    values = np.empty((len(objects), PAPER_SWEEP.n_evaluations))
    solver_s = 0.0
    for index, Q in enumerate(objects):
        i = 0
        for scale in PAPER_SWEEP.scale:
            for shift in PAPER_SWEEP.translation:
                for angle in PAPER_SWEEP.angle_rad:
                    inverse = np.linalg.inv(plain_matrix(scale, shift, angle))
                    moved = inverse.T @ Q @ inverse
                    start = time.perf_counter()
                    eigenvalues = np.linalg.eigvalsh(moved)
                    solver_s += time.perf_counter() - start
                    values[index, i] = np.abs(eigenvalues).min()
                    i += 1
    return values, solver_s


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeats", type=int, default=3, help="runs of the sweep, the best counts")
    arguments = parser.parse_args()

    start = time.perf_counter()
    expected, solver_s = plain_loops(OBJECTS)
    plain_s = time.perf_counter() - start
    taken = []
    for _ in range(arguments.repeats):
        start = time.perf_counter()
        found = sweep(OBJECTS).value
        taken.append(time.perf_counter() - start)
    sweep_s = min(taken)
    difference = float(np.max(np.abs(found / expected - 1.0)))

    print(f"matrices             {expected.size}")
    print(f"plain loops          {plain_s:.3f} s (eigvalsh alone {solver_s:.3f} s)")
    print(f"sweep                {sweep_s:.3f} s, {sweep_s / expected.size * 1e9:.0f} ns a matrix")
    print(f"ratio                {plain_s / sweep_s:.1f} (eigvalsh alone {solver_s / sweep_s:.1f})")
    print(f"largest difference   {difference:.1e} relative")
    if not difference < 1e-9:
        raise SystemExit("the sweep's values are not those of the plain loops")


if __name__ == "__main__":
    main()
