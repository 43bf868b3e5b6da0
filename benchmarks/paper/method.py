"""The paper's mathematics in numbers: each row of "What holds" in docs/developers/paper.md."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from benchmarks._measure import line, repeats
from benchmarks.paper.reproduction import (
    LABELS,
    NOISE_SHARES,
    SEED,
    TOUCH_N,
    press,
    random_grasp,
    record,
)
from recognition.errors import QuadricError
from recognition.grasp import Grasp
from recognition.quadric.level import MeanFrames
from recognition.quadric.proofs import (
    SOLVERS,
    column_sums,
    least_quotient,
    precise_smallest,
    ramp_surface,
    sdp_bound,
    substituted,
)
from recognition.quadric.quadric import (
    PAPER_SWEEP,
    Reading,
    SweepSettings,
    by_inverse,
    height_field_matrix,
    rotation_xyz,
    scaling,
    smallest_eigenvalue,
    sweep,
    translation,
)
from recognition.recognizer import UNKNOWN
from recognition.recognizers.level_check import LevelCheckTrainer
from simulator.world.shapes import ObjectPose

Array = NDArray[np.float64]
SEMI_AXES_MM = ((7.0, 7.0, 5.85), (3.0, 3.0, 100.0), (5.0, 7.95, 5.0), (4.75, 4.75, 4.75))
"""Oval, cylinder (closed by a large ellipsoid: an exact one has no level), box and ball."""
FULL = np.array(
    [np.diag([*(1 / np.square(axes)), -1.0]) for axes in SEMI_AXES_MM]
    + [np.diag([1 / 25.0, 1 / 25.0, -1 / 6.5**2, -1.0])]
)
"""(5, 4, 4): the paper's objects as full quadrics in mm, the dumbbell last."""
RADII_MM = ((8.4, 8.4), (3.0, 3333.0), (5.0, 12.6), (4.75, 4.75), (5.0, -8.5))
"""Radii of curvature in mm of the side that a pad meets."""
_FORCE_N, _FOAM_N_MM3 = 5.0, 0.05
"""Force on each cap, and foam of 150 kPa and 3 mm; the ball then has 200 counts."""
TOLERATED = 0.08
"""Noise that the paper's levels tolerate."""


def caps() -> Array:
    """Return the caps of the five objects in the form (7), (5, 4, 4): heights in counts, mm."""
    depth_mm = [
        np.sqrt(_FORCE_N / (_FOAM_N_MM3 * np.pi * np.sqrt(abs(first * second))))
        for first, second in RADII_MM
    ]
    counts_mm = 200.0 / depth_mm[3]
    return np.array(
        [
            height_field_matrix(
                a=-counts_mm / (2 * first), b=-counts_mm / (2 * second), k=counts_mm * depth
            )
            for (first, second), depth in zip(RADII_MM, depth_mm, strict=True)
        ]
    )


def inverses(settings: SweepSettings) -> Array:
    """Return M^-1 of a grid, (n, 4, 4): x and y apart, the three angles apart."""
    shifts = np.stack(np.meshgrid(*[settings.translation] * 2), axis=-1).reshape(-1, 2)
    turns = np.stack(np.meshgrid(*[settings.angle_rad] * 3), axis=-1).reshape(-1, 3)
    back = translation(np.column_stack([-shifts, np.zeros(len(shifts))]))
    turned = np.swapaxes(rotation_xyz(turns), -1, -2)
    scaled = scaling(1.0 / settings.scale)
    return (scaled[:, None, None] @ turned[:, None] @ back).reshape(-1, 4, 4)


STILL = replace(PAPER_SWEEP, scale=np.ones(1), translation=np.zeros(1), angle_rad=np.zeros(1))
KINDS = {
    "rotation": replace(STILL, angle_rad=PAPER_SWEEP.angle_rad),
    "translation": replace(STILL, translation=PAPER_SWEEP.translation),
    "scale": replace(STILL, scale=PAPER_SWEEP.scale),
    "rotation, displaced": replace(
        PAPER_SWEEP, scale=np.ones(1), translation=np.array([-2.0, 0.0, 2.0])
    ),
}
"""Kinds of transformations, over the paper's grid."""


def spread(matrices: Array, settings: SweepSettings, reading: Reading) -> str:
    """Return how far the eigenvalues of each object go over a grid, as parts of that at rest."""
    M_inv = inverses(settings)
    rest = smallest_eigenvalue(matrices, reading).value
    values = [smallest_eigenvalue(by_inverse(Q, M_inv), reading).value for Q in matrices]
    if len(settings.scale) > 1:
        return "factor " + ", ".join(f"{np.abs(v).max() / np.abs(v).min():.1f}" for v in values)
    parts = (np.ptp(v) / abs(at) for v, at in zip(values, rest, strict=True))
    return ", ".join(f"{part:.1e}" for part in parts)


def infimum(n: int) -> None:
    """Print eq. (4) to (6) against the eigenvalue, without and with its solver."""
    rng = np.random.default_rng(5)
    free = rng.normal(size=(n, 4, 4))
    matrices = [*FULL, *caps(), *(free + np.swapaxes(free, 1, 2))]
    off, above = 0.0, 0.0
    for Q in matrices:
        lowest, size = float(np.linalg.eigvalsh(Q)[0]), float(np.abs(Q).max())
        off = max(off, abs(sdp_bound(Q, np.eye(4)) - lowest) / size)
        reached = least_quotient(Q, np.eye(4))
        above = max(above, (reached - lowest) / size)
    text = f"off by {off:.0e} of the largest entry at most, {len(matrices)} matrices"
    line("eq. (5), (6)", f"the semidefinite bound is the smallest eigenvalue: {text}")
    line("eq. (4)", f"descents over points end at most {above:.0e} of the largest entry above it")


def transformed(n: int) -> None:
    """Print eq. (8) to (10) against the true product."""
    rng = np.random.default_rng(3)
    points = np.column_stack([rng.uniform(-5, 5, (50, 3)), np.ones(50)])
    Q = caps()[3]
    lowest = float(np.linalg.eigvalsh(Q)[0])
    for kind, settings in KINDS.items():
        every = inverses(settings)
        M_inv = every[rng.choice(len(every), min(n, len(every)), replace=False)]
        true = points @ np.swapaxes(M_inv, -1, -2)
        off = np.linalg.norm(points @ column_sums(M_inv) - true, axis=-1) / np.linalg.norm(
            true, axis=-1
        )
        right = np.mean(off.max(axis=1) < 1e-12)
        line("eq. (8)", f"{kind}: column sums are M^-1 P for {right:.0%} of {len(M_inv)}")
        infima = [abs(sdp_bound(*substituted(Q, one)) / lowest - 1.0) for one in M_inv[:30]]
        moved = [abs(np.linalg.eigvalsh(by_inverse(Q, one))[0] / lowest - 1.0) for one in M_inv]
        text = (
            f"infimum of (9) moves by {max(infima):.0e}, eigenvalue of Q' by up to {max(moved):.0%}"
        )
        line("eq. (9), (10)", f"{kind}: {text}")
    try:
        sdp_bound(*(column_sums(translation([1.0, 0.0, 0.0])),) * 2)
    except QuadricError as undefined:
        line("eq. (8)", f"translation by -1: {undefined}")


def invariance() -> None:
    """Print what Algorithm 1's eigenvalue keeps over the paper's grid."""
    for form, matrices in (("full quadrics", FULL), ("form (7)", caps())):
        for reading in Reading:
            for kind, settings in KINDS.items():
                line(form, f"{reading.value}, {kind}: {spread(matrices, settings, reading)}")


def solvers(n: int) -> None:
    """Print the errors of the solvers in double and single precision."""
    rng = np.random.default_rng(4)
    axes, _ = np.linalg.qr(rng.normal(size=(n, 4, 4)))
    sizes = np.stack([np.full(n, 1e-3), rng.uniform(0.5, 9, n), rng.uniform(0.5, 9, n)], axis=1)
    values = np.column_stack([sizes, np.full(n, 1e2)]) * rng.choice([-1.0, 1.0], (n, 4))
    double = axes * values[:, None] @ np.swapaxes(axes, 1, 2)
    double = 0.5 * (double + np.swapaxes(double, 1, 2))
    single = double.astype(np.float32)
    for name, solver in SOLVERS.items():
        worst, beyond = [], []
        for Q in (double, single):
            with np.errstate(all="ignore"):
                off = np.abs(solver(Q) / precise_smallest(Q.astype(np.float64)) - 1.0)
            off = np.where(np.isfinite(off), off, np.inf)
            worst.append(f"{off.max():.1e}")
            beyond.append(f"{np.mean(off > TOLERATED):.1%}")
        text = f"double: worst {worst[0]}, {beyond[0]} beyond 8 %; single: {beyond[1]} beyond 8 %"
        line(name, f"{text}, {n} matrices with 1e-3 to 1e2")


def five_dimensions() -> None:
    """Print the 5x5 form with the grip force beside the 4x4 form."""
    along = np.linspace(-1.5, 1.5, 5)
    xy = np.stack(np.meshgrid(along, along), axis=-1).reshape(-1, 2)
    share = np.repeat(np.linspace(0.1, 1.0, 10), len(xy))
    places = np.tile(xy, (10, 1))
    x, y = places.T
    fives = [
        ramp_surface(places, share, Q[0, 0] * x * x + Q[1, 1] * y * y + Q[3, 3] * np.sqrt(share))
        for Q in caps()
    ]
    fourth = smallest_eigenvalue(caps()).value
    fifth = np.abs(np.linalg.eigvalsh(fives)).min(axis=1)
    text = "the same" if list(np.argsort(fifth)) == list(np.argsort(fourth)) else "another"
    line("5 x 5", f"{text} order of the objects: {np.round(fifth, 4)} and {np.round(fourth, 4)}")


def drawn(seed: int, noise_share: float, n: int) -> list[Grasp]:
    """Return n grasps of each object in random poses, with noise up to a part of full scale."""
    rng = np.random.default_rng([SEED, seed, round(100 * noise_share)])
    return [random_grasp(label, rng, noise_share) for label in LABELS for _ in range(n)]


def bands_and_windows(n: int) -> None:
    """Print the bands of Algorithm 1's sweep beside taught ones, and its windows under noise."""
    quiet = LevelCheckTrainer().fit(drawn(0, 0.0, n))
    for index, label in enumerate(quiet.labels):
        still = record(press(label, ObjectPose(), TOUCH_N), np.random.default_rng(SEED), 0.0)
        swept = sweep(np.array(MeanFrames.of(still, quiet.force_n).surfaces()[:1]))
        text = f"taught {quiet.low[index]:.5f} to {quiet.high[index]:.5f}, by the sweep"
        line(f"bands, {label}", f"{text} {swept.min():.5f} to {swept.max():.5f}")
    for noise_share in NOISE_SHARES[1:]:
        loud, tested = (drawn(seed, noise_share, n) for seed in (1, 2))
        unchanged = replace(quiet, noise_per_count=0.0)
        rules = {
            "taught without noise": unchanged,
            "the same, windows adjusted to the noise": quiet,
            "taught again at this noise": LevelCheckTrainer().fit(loud),
        }
        for teaching, rule in rules.items():
            named = [(grasp.label, rule.check(grasp)) for grasp in tested]
            right = sum(label == name for label, name in named)
            none = sum(name == UNKNOWN for _, name in named)
            text = f"{right} right, {len(named) - right - none} wrong, {none} without a name"
            line(f"noise {noise_share:.0%}", f"{teaching}: {text}")


def main(effort: float = 1.0) -> None:
    """Print all rows."""
    line("compared", "the paper's equations, with the true products and eigenvalues")
    infimum(repeats(200, effort, least=10))
    transformed(repeats(300, effort, least=30))
    invariance()
    solvers(repeats(500, effort, least=20))
    five_dimensions()
    bands_and_windows(repeats(40, effort, least=4))
