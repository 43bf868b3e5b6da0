"""The paper's mathematics in numbers: each row of "What holds" in docs/developers/paper.md.

A residual is how far a claim is from what is true; the claim holds up to a limit. A quotient
v.P v / v.N v over v = (x, 1) is given by two symmetric matrices P and N, (4, 4) float64.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy import optimize

from benchmarks._measure import line, repeats
from benchmarks.paper.reproduction import LABELS, SEED, TOUCH_N, press, random_grasp, still_surfaces
from recognition.errors import QuadricError
from recognition.grasp import Grasp
from recognition.quadric.quadric import (
    PAPER_SWEEP,
    J,
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
Matrices = NDArray[np.floating]
"""(n, 4, 4): symmetric, in double or single precision."""
SEMI_AXES_MM = ((7.0, 7.0, 5.85), (3.0, 3.0, 100.0), (5.0, 7.95, 5.0), (4.75, 4.75, 4.75))
"""Oval, cylinder (closed by a large ellipsoid: an exact one has no level), box and ball."""
FULL = np.array(
    [np.diag([*(1 / np.square(axes)), -1.0]) for axes in SEMI_AXES_MM]
    + [np.diag([1 / 25.0, 1 / 25.0, -1 / 6.5**2, -1.0])]
)
"""(5, 4, 4): the paper's objects as full quadrics in mm, the dumbbell last."""
RADII_MM = np.array([(8.4, 8.4), (3.0, 3333.0), (5.0, 12.6), (4.75, 4.75), (5.0, -8.5)])
"""Radii of curvature in mm of the side that a pad meets."""
_FORCE_N, _FOAM_N_MM3 = 5.0, 0.05
"""Force on each cap, and foam of 150 kPa and 3 mm; the ball then has 200 counts."""
_DEPTH_MM = np.sqrt(_FORCE_N / (_FOAM_N_MM3 * np.pi * np.sqrt(np.abs(RADII_MM.prod(axis=1)))))
_COUNTS_MM = 200.0 / _DEPTH_MM[3]
CAPS = np.array(
    [
        height_field_matrix(a=a, b=b, k=_COUNTS_MM * depth)
        for (a, b), depth in zip(-_COUNTS_MM / (2 * RADII_MM), _DEPTH_MM, strict=True)
    ]
)
"""(5, 4, 4): their caps in the form (7), heights in counts over mm."""
TOLERATED = 0.08
"""Noise that the paper's levels tolerate."""
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


def inverses(settings: SweepSettings) -> Array:
    """Return M^-1 of a grid, (n, 4, 4): x and y apart, the three angles apart."""
    shifts = np.stack(np.meshgrid(*[settings.translation] * 2), axis=-1).reshape(-1, 2)
    turns = np.stack(np.meshgrid(*[settings.angle_rad] * 3), axis=-1).reshape(-1, 3)
    back = translation(np.column_stack([-shifts, np.zeros(len(shifts))]))
    turned = np.swapaxes(rotation_xyz(turns), -1, -2)
    scaled = scaling(1.0 / settings.scale)
    return (scaled[:, None, None] @ turned[:, None] @ back).reshape(-1, 4, 4)


def some_inverses(kind: str, n: int) -> Array:
    """Return up to n of the inverses of a kind, drawn at random."""
    return np.random.default_rng(3).permutation(inverses(KINDS[kind]))[:n]


# -- Infimum of the quotient: equations (4) to (6) and (8) to (10) ---------------------------------


def _is_definite(A: Array) -> bool:
    try:
        np.linalg.cholesky(A)
    except np.linalg.LinAlgError:
        return False
    return True


def sdp_bound(P: Array, N: Array) -> float:
    """Solve the semidefinite program of eq. (5), max alpha with P - alpha N >= 0, by bisection.

    No eigenvalue is used. For two quadratic polynomials the bound is the infimum of eq. (4). Raises
    QuadricError where N is not positive definite: then the quotient has no infimum.
    """
    if not _is_definite(N):
        raise QuadricError("the denominator is not positive definite: no infimum is defined")
    high = float(np.min(np.diag(P) / np.diag(N)))
    low = -2.0 * float(np.linalg.norm(P) * np.linalg.norm(np.linalg.inv(N))) - np.finfo(float).tiny
    while low < (middle := 0.5 * (low + high)) < high:
        low, high = (middle, high) if _is_definite(P - middle * N) else (low, middle)
    return low


def least_quotient(P: Array) -> float:
    """Return the least v.P v / v.v of eq. (4) that descents from eight points reach."""

    def quotient(x: Array) -> tuple[float, Array]:
        v = np.append(x, 1.0)
        value = float(v @ P @ v / (v @ v))
        return value, 2.0 * (P @ v - value * v)[:-1] / (v @ v)

    starts = np.random.default_rng(0).normal(size=(8, 3)) * np.geomspace(0.1, 100.0, 8)[:, None]
    return min(
        float(optimize.minimize(quotient, x, jac=True, method="BFGS", options={"gtol": 1e-12}).fun)
        for x in starts
    )


def eigenvalue_error(infimum: Callable[[Array], float], n: int) -> Array:
    """Return how far an infimum is from the smallest eigenvalue, as parts of the largest entry."""
    free = np.random.default_rng(5).normal(size=(n, 4, 4))
    matrices = [*FULL, *CAPS, *(free + np.swapaxes(free, 1, 2))]
    parts = [abs(infimum(Q) - np.linalg.eigvalsh(Q)[0]) / np.abs(Q).max() for Q in matrices]
    return np.max(parts, keepdims=True)


def column_sums(M_inv: Array) -> Array:
    """Return the diagonal matrix (..., 4, 4) that eq. (8) has in the place of M^-1."""
    return np.asarray(M_inv.sum(axis=-2)[..., None] * np.eye(4))


def wrong_products(kind: str, n: int) -> Array:
    """Return the share of transformations for which eq. (8) is not M^-1 P."""
    points = np.column_stack([np.random.default_rng(3).uniform(-5, 5, (50, 3)), np.ones(50)])
    M_inv = some_inverses(kind, n)
    true = points @ np.swapaxes(M_inv, -1, -2)
    differs = np.linalg.norm(points @ column_sums(M_inv) - true, axis=-1)
    is_wrong = (differs > 1e-12 * np.linalg.norm(true, axis=-1)).any(axis=1)
    return np.mean(is_wrong, keepdims=True)


def without_infimum() -> Array:
    """Return 1 where eq. (8) leaves eq. (9) without an infimum for a translation by 1, else 0."""
    sums = column_sums(translation([-1.0, 0.0, 0.0]))
    try:
        sdp_bound(by_inverse(CAPS[3], sums), by_inverse(np.eye(4), sums))
    except QuadricError:
        return np.ones(1)
    return np.zeros(1)


def infimum_moves(kind: str, n: int) -> Array:
    """Return how far the infimum of eq. (9) moves, where M^-1 v replaces v above and below."""
    lowest = np.linalg.eigvalsh(CAPS[3])[0]
    bounds = [
        sdp_bound(by_inverse(CAPS[3], inverse), by_inverse(np.eye(4), inverse))
        for inverse in some_inverses(kind, n)
    ]
    return np.max(np.abs(bounds / lowest - 1.0), keepdims=True)


# -- Invariance of Algorithm 1's eigenvalue --------------------------------------------------------


def varies(matrices: Array, reading: Reading, kind: str) -> Array:
    """Return the largest over the smallest eigenvalue of each object on a grid, less 1."""
    M_inv = inverses(KINDS[kind])
    values = [np.abs(smallest_eigenvalue(by_inverse(Q, M_inv), reading).value) for Q in matrices]
    return np.array([value.max() / value.min() for value in values]) - 1.0


# -- Solvers of section 3: each takes matrices and returns min |lambda| in their precision ---------


def _coefficients(Q: Matrices) -> Matrices:
    """Return the characteristic polynomial, highest power first (Faddeev and Le Verrier)."""
    n, M = Q.shape[-1], np.zeros_like(Q)
    out = np.ones((len(Q), n + 1), dtype=Q.dtype)
    for k in range(1, n + 1):
        M = Q @ M + out[:, k - 1, None, None] * np.eye(n, dtype=Q.dtype)
        out[:, k] = -np.trace(Q @ M, axis1=1, axis2=2) / Q.dtype.type(k)
    return out


def _polynomial(Q: Matrices) -> Matrices:
    """Find the root of the polynomial near 0 by 60 steps of Newton's method."""
    c, x = _coefficients(Q).T, np.zeros(len(Q), dtype=Q.dtype)
    slopes = c[:-1] * np.arange(len(c) - 1, 0, -1, dtype=Q.dtype)[:, None]
    for _ in range(60):
        slope = np.polyval(slopes, x)
        x = x - np.polyval(c, x) / np.where(slope == 0, np.finfo(Q.dtype).tiny, slope)
    return np.abs(x)


def _companion(Q: Matrices) -> Matrices:
    C = np.zeros_like(Q)
    C[:, 0, :] = -_coefficients(Q)[:, 1:]
    C[:, range(1, Q.shape[-1]), range(Q.shape[-1] - 1)] = 1
    return _qr(C)


def _power(Q: Matrices) -> Matrices:
    """Iterate v <- Q^-1 v, 60 times, then take Rayleigh's quotient."""
    inverse, v = np.linalg.inv(Q), np.ones((len(Q), Q.shape[-1], 1), dtype=Q.dtype)
    for _ in range(60):
        v = inverse @ v
        v /= np.linalg.norm(v, axis=1, keepdims=True)
    return np.abs(1 / (np.swapaxes(v, 1, 2) @ inverse @ v)[:, 0, 0])


def _qr(Q: Matrices) -> Matrices:
    return np.abs(np.linalg.eigvals(Q)).min(axis=-1)


def _symmetric_qr(Q: Matrices) -> Matrices:
    return np.abs(np.linalg.eigvalsh(Q)).min(axis=-1)


SOLVERS: Mapping[str, Callable[[Matrices], Matrices]] = {
    "characteristic polynomial": _polynomial,
    "companion matrix": _companion,
    "power method on the inverse": _power,
    "QR (eigvals)": _qr,
    "symmetric QR (eigvalsh)": _symmetric_qr,
}


def unusable(name: str, precision: type[np.floating], n: int) -> Array:
    """Return the share of matrices with 1e-3 to 1e2 where a solver is off by more than 8 %."""
    rng, least = np.random.default_rng(4), 1e-3
    axes, _ = np.linalg.qr(rng.normal(size=(n, 4, 4)))
    sizes = np.column_stack([np.full(n, least), rng.uniform(0.5, 9, (n, 2)), np.full(n, 1e2)])
    Q = axes * (sizes * rng.choice([-1.0, 1.0], (n, 4)))[:, None] @ np.swapaxes(axes, 1, 2)
    Q = (0.5 * (Q + np.swapaxes(Q, 1, 2))).astype(precision)
    with np.errstate(all="ignore"):
        is_right = np.abs(SOLVERS[name](Q) / least - 1.0) <= TOLERATED
    return np.mean(~is_right, keepdims=True)


# -- What the objects' levels separate -------------------------------------------------------------


def ramp_surface(xy: Array, share: Array, height: Array) -> Array:
    """Fit the 5x5 form with the grip force as fifth coordinate: P = (x, y, z, w, 1).

    Parameters
    ----------
    xy, share, height
        (n, 2), (n,) and (n,) float64: places, part w of the full force, and heights there.
    """
    x, y = xy.T
    w = share
    columns = [x * x, y * y, 2 * x * y, 2 * x * w, 2 * y * w, w * w, 2 * x, 2 * y, 2 * w, w**0]
    a, b, d, g, h, k, l, m, n, o = np.linalg.lstsq(np.stack(columns, axis=1), height)[0]  # noqa: E741
    rows = [[a, d, 0, g, l], [d, b, 0, h, m], [0, 0, 0, 0, J], [g, h, 0, k, n], [l, m, J, n, o]]
    return np.array(rows, dtype=np.float64)


def same_order() -> Array:
    """Return 1 where the 5x5 form orders the objects' levels as the 4x4 form does, else 0."""
    along = np.linspace(-1.5, 1.5, 5)
    x, y, share = (grid.ravel() for grid in np.meshgrid(along, along, np.linspace(0.1, 1.0, 10)))
    fives = [
        ramp_surface(
            np.column_stack([x, y]), share, Q[0, 0] * x * x + Q[1, 1] * y * y + Q[3, 3] * share**0.5
        )
        for Q in CAPS
    ]
    orders = [np.argsort(np.abs(np.linalg.eigvalsh(form)).min(axis=1)) for form in (fives, CAPS)]
    return np.array([float(np.array_equal(*orders))])


def overlapping() -> Array:
    """Return the share of pairs of objects whose bands of Algorithm 1's sweep overlap."""
    values = sweep(still_surfaces([press(label, ObjectPose(), TOUCH_N) for label in LABELS]))
    bands = zip(values.min(axis=1), values.max(axis=1), strict=True)
    pairs = combinations(bands, 2)
    return np.mean([max(a[0], b[0]) <= min(a[1], b[1]) for a, b in pairs], keepdims=True)


def drawn(seed: int, noise_share: float, n: int) -> list[Grasp]:
    """Return n grasps of each object in random poses, with noise up to a part of full scale."""
    rng = np.random.default_rng([SEED, seed, round(100 * noise_share)])
    return [random_grasp(label, rng, noise_share) for label in LABELS for _ in range(n)]


def unnamed(noise_share: float, n: int) -> Array:
    """Return the share of grasps that windows adjusted to the noise do not name."""
    taught = LevelCheckTrainer().fit(drawn(0, 0.0, n))
    names = [taught.check(grasp) for grasp in drawn(2, noise_share, n)]
    return np.mean([name == UNKNOWN for name in names], keepdims=True)


Claim = tuple[str, str, Callable[[], Array], float]
"""Where it is, what is claimed, its residuals, and the largest with which it holds."""


def claims(effort: float) -> list[Claim]:
    """Return all claims."""
    n, n_drawn = repeats(300, effort, least=20), repeats(40, effort, least=4)
    bound = partial(sdp_bound, N=np.eye(4))
    rows: list[Claim] = [
        (
            "eq. (5), (6)",
            "the bound is the least eigenvalue",
            partial(eigenvalue_error, bound, n),
            1e-13,
        ),
        ("eq. (4)", "descents end at it", partial(eigenvalue_error, least_quotient, n), 1e-9),
    ]
    for kind in KINDS:
        rows += [
            ("eq. (8)", f"column sums give each {kind}", partial(wrong_products, kind, n), 0.0),
            ("eq. (9)", f"{kind} keeps the infimum", partial(infimum_moves, kind, n // 10), 1e-12),
        ]
    rows.append(("eq. (8)", "a translation by 1 leaves an infimum", without_infimum, 0.0))
    for form, matrices in (("full quadrics", FULL), ("form (7)", CAPS)):
        rows += [
            (form, f"{kind} keeps the {reading}", partial(varies, matrices, reading, kind), 0.01)
            for reading in Reading
            for kind in KINDS
        ]
    for precision in (np.float64, np.float32):
        usable = f"within 8 % in {precision.__name__}"
        rows += [(name, usable, partial(unusable, name, precision, n), 0.0) for name in SOLVERS]
    rows += [
        ("5 x 5", "the objects have another order than with 4 x 4", same_order, 0.0),
        ("bands", "none overlap after the sweep", overlapping, 0.0),
        ("windows", "noise of 8 % leaves names", partial(unnamed, 0.08, n_drawn), 0.04),
        ("windows", "noise of 20 % leaves names", partial(unnamed, 0.2, n_drawn), 0.04),
    ]
    return rows


def main(effort: float = 1.0) -> None:
    """Print all claims with their residuals."""
    line("compared", "the paper's claims with what is true: residuals, the largest that holds")
    for where, claim, residuals, limit in claims(effort):
        values = residuals()
        verdict = "holds" if values.max() <= limit else "does not hold"
        text = ", ".join(f"{value:.1e}" for value in values)
        line(where, f"{claim}: {text} ({limit:g}): {verdict}")
