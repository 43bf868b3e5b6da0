"""What of the paper's invariance claim holds, per transformation, over the paper's grid.

The five objects stand as full quadrics (mm, k = -1) and in the form (7): the cap that each shows to
a pad, in counts. A cap's height is that of a paraboloid of the object's radii pressed with 5 N into
foam of 150 kPa and 3 mm, the ball's being 200 counts. Then equations (4) to (10) in numbers: the
semidefinite bound against eigvalsh, and column sums against the true product M^-1 P; and the 5x5
form of the conclusions, fitted along a force ramp.

The paper leaves open what the fifth coordinate w is. Here it is the grip force as a part of the
full force of the ramp, from 0 to 1: the one further quantity that every frame has and that no pose
changes. The surface then holds how the height field grows along the ramp::

    z = a x^2 + b y^2 + 2 d xy + 2 w (g x + h y) + k w^2 + 2 (w1 x + w2 y + w4 w) + w5

        | a  d  0  g  w1 |
    Q = | d  b  0  h  w2 |      w3 = -1/2, the place of j in the form (7)
        | 0  0  0  0  w3 |
        | g  h  0  k  w4 |
        | w1 w2 w3 w4 w5 |
"""

from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType

import numpy as np

from benchmarks._measure import line, repeats, same
from benchmarks.paper.infimum import approach_infimum, printed, sdp_bound, substituted
from recognition.errors import QuadricError
from recognition.quadric.eigen import Reading, smallest_eigenvalue
from recognition.quadric.quadric import (
    J,
    by_inverse,
    congruence,
    height_field_matrix,
    scaling,
    translation,
)
from recognition.quadric.trajectory import PAPER_SWEEP, Axes, SweepSettings, inverse_poses, sweep

NAMES = ("oval", "cylinder", "box", "ball", "dumbbell")
# the cylinder is closed by a large ellipsoid: an exact one has no level
_SEMI_AXES_MM = ((7.0, 7.0, 5.85), (3.0, 3.0, 100.0), (5.0, 7.95, 5.0), (4.75, 4.75, 4.75))
OBJECTS = np.array(
    [np.diag([*(1 / np.square(axes)), -1.0]) for axes in _SEMI_AXES_MM]
    + [np.diag([1 / 25.0, 1 / 25.0, -1 / 6.5**2, -1.0])]
)
# radii of curvature of the side that a pad meets, mm, from the semi-axes
_RADII_MM = (
    (49 / 5.85, 49 / 5.85),
    (3.0, 100.0**2 / 3.0),
    (5.0, 7.95**2 / 5.0),
    (4.75, 4.75),
    (5.0, -(6.5**2) / 5.0),
)
_FORCE_N, _FOAM_N_MM3, _BALL_COUNTS = 5.0, 0.150 / 3.0, 200.0
_STILL = replace(PAPER_SWEEP, scale=np.ones(1), translation=np.zeros(1), angle_rad=np.zeros(1))
TRANSFORMATIONS: Mapping[str, SweepSettings] = MappingProxyType(
    {
        "rotation": replace(_STILL, angle_rad=PAPER_SWEEP.angle_rad, rotation_axes=Axes.SEPARATE),
        "translation": replace(
            _STILL, translation=PAPER_SWEEP.translation, translation_axes=Axes.SEPARATE
        ),
        "scale": replace(_STILL, scale=PAPER_SWEEP.scale),
        "rotation, translation": replace(PAPER_SWEEP, scale=np.ones(1)),
        "all three loops": PAPER_SWEEP,
    }
)
"""The paper's grid by kind: three angles about the origin, x and y, scale; then together."""


def caps() -> np.ndarray:
    """Return the form (7) of the five objects, heights in counts, x and y in mm."""
    indentation_mm = [
        np.sqrt(_FORCE_N / (_FOAM_N_MM3 * np.pi * np.sqrt(abs(r1 * r2)))) for r1, r2 in _RADII_MM
    ]
    counts_mm = _BALL_COUNTS / indentation_mm[3]
    return np.array(
        [
            height_field_matrix(
                a=-counts_mm / (2 * r1), b=-counts_mm / (2 * r2), k=counts_mm * depth
            )
            for (r1, r2), depth in zip(_RADII_MM, indentation_mm, strict=True)
        ]
    )


def table(form: str, matrices: np.ndarray, reading: Reading) -> None:
    """Print the width of the values as a part of the value at rest; scale as a factor."""
    head = f"{form}, {'min |lambda|' if reading is Reading.SMALLEST_MAGNITUDE else 'lambda_min'}"
    print(f"\n{head:<38}" + "".join(f"{name:>12}" for name in NAMES))
    at_rest = smallest_eigenvalue(matrices, reading).value
    for kind, settings in TRANSFORMATIONS.items():
        value = sweep(matrices, replace(settings, reading=reading)).value
        print(f"  {kind:<36}" + "".join(shown(kind, value, at_rest)))
        same(
            kind != "rotation" or bool(np.all(np.ptp(value, axis=1) < 1e-8 * np.abs(at_rest))),
            "rotation about the origin changes an eigenvalue",
        )
    print(f"  {'value at rest':<36}" + "".join(f"{one:12.4g}" for one in at_rest))


def shown(kind: str, value: np.ndarray, at_rest: np.ndarray) -> list[str]:
    """Return how far the values (n_objects, n) go: a factor over scales, else a part."""
    if "scale" in kind or "loops" in kind:
        return [f"{one.max() / one.min():11.3f}x" for one in np.abs(value)]
    return [f"{one:12.1e}" for one in np.ptp(value, axis=1) / np.abs(at_rest)]


def corrected_eigenvalue(Q: np.ndarray) -> np.ndarray:
    """Return min |lambda| of quadrics (..., 4, 4) made independent of the pose and of scale.

    The origin is moved to the quadric's centre, lengths are divided by the root mean square of the
    semi-axes' magnitudes, a_i^2 = -det Q / (det A lambda_i(A)), and Q is scaled to k = -1. What
    remains depends on the ratios of the axes alone. Raises numpy's LinAlgError for a quadric
    without a single centre.
    """
    A, b = Q[..., :3, :3], Q[..., :3, 3, None]
    centre = -np.linalg.solve(A, b)[..., 0]
    # det Q / det A is k at the centre, by Schur's complement
    k = Q[..., 3, 3] + np.einsum("...i,...i->...", b[..., 0], centre)
    radius = np.sqrt(np.mean(np.abs(k[..., None] / np.linalg.eigvalsh(A)), axis=-1))
    moved = congruence(Q, scaling(1.0 / radius) @ translation(-centre))
    return smallest_eigenvalue(moved / -moved[..., 3, 3, None, None]).value


def corrected(n: int) -> None:
    """Print by how much the corrected feature changes over poses of the grid."""
    rng = np.random.default_rng(2)
    M_inv = inverses("all three loops")
    M_inv = M_inv[rng.choice(len(M_inv), min(n, len(M_inv)), replace=False)]
    widths = []
    for Q in OBJECTS:
        moved = corrected_eigenvalue(by_inverse(Q, M_inv))
        widths.append(np.ptp(moved) / float(corrected_eigenvalue(Q)))
    print(
        f"\n{'corrected feature, ' + str(len(M_inv)) + ' poses':<38}"
        + "".join(f"{width:12.1e}" for width in widths)
    )


def inverses(kind: str) -> np.ndarray:
    """Return M^-1 of every pose of one kind, (n, 4, 4)."""
    return np.concatenate(list(inverse_poses(TRANSFORMATIONS[kind])))


def column_sums(n: int) -> None:
    """Print equations (8) to (10) against the true product."""
    rng = np.random.default_rng(3)
    P = np.column_stack([rng.uniform(-5, 5, (50, 3)), np.ones(50)])
    heads = ("right for", "median off", "worst off", "undefined", "(9) keeps inf", "true keeps inf")
    print(f"\n{'eq. (8)-(10), M^-1 P':<26}" + "".join(f"{head:>15}" for head in heads))
    Q = caps()[3]
    infimum = sdp_bound(Q, np.eye(4))
    for kind in TRANSFORMATIONS:
        M_inv = inverses(kind)
        if len(M_inv) > n:
            M_inv = M_inv[rng.choice(len(M_inv), n, replace=False)]
        columns = M_inv.sum(axis=-2)[:, None] * P
        true = np.einsum("nij,pj->npi", M_inv, P)
        off = np.linalg.norm(columns - true, axis=-1) / np.linalg.norm(true, axis=-1)
        off = off.max(axis=1)
        kept, undefined, true_kept = 0, 0, 0
        for one in M_inv[: n // 10]:
            try:
                bound = sdp_bound(*printed(Q, one))
            except QuadricError:
                undefined += 1
            else:
                kept += abs(bound / infimum - 1.0) < 1e-6
            true_bound = sdp_bound(*substituted(Q, one))
            true_kept += abs(true_bound / infimum - 1.0) < 1e-6
        tried = len(M_inv[: n // 10])
        print(
            f"  {kind:<24}{np.mean(off < 1e-12):15.1%}{np.median(off):15.2g}{off.max():15.2g}"
            + "".join(f"{f'{count} of {tried}':>15}" for count in (undefined, kept, true_kept))
        )


def bounds() -> None:
    """Print the semidefinite bound, the best point found, and eigvalsh."""
    print(f"\n{'eq. (4)-(6)':<26}{'SDP bound':>22}{'eigvalsh':>22}{'descent':>22}{'|x|':>9}")
    for form, matrices in (("full", OBJECTS), ("(7)", caps())):
        for name, Q in zip(NAMES, matrices, strict=True):
            bound = sdp_bound(Q, np.eye(4))
            reached, x = approach_infimum(Q, np.eye(4))
            lowest = float(np.linalg.eigvalsh(Q)[0])
            same(
                abs(bound - lowest) < 1e-12 * np.abs(Q).max(),
                f"the bound of the {name} is not its smallest eigenvalue",
            )
            same(reached >= lowest - 1e-9, "a point lies below the infimum")
            print(
                f"  {name + ', ' + form:<24}{bound:22.15g}{lowest:22.15g}"
                f"{reached:22.15g}{np.linalg.norm(x):9.2g}"
            )


def fit_ramp_surface(xy: np.ndarray, w: np.ndarray, height: np.ndarray) -> np.ndarray:
    """Fit the 5x5 form to heights (n_frames, n_points) at places (n_points, 2), w (n_frames,)."""
    x, y = np.tile(xy, (len(w), 1)).T
    f = np.repeat(w, len(xy))
    columns = [x * x, y * y, 2 * x * y, 2 * x * f, 2 * y * f, f * f, 2 * x, 2 * y, 2 * f, f**0]
    found = np.linalg.lstsq(np.column_stack(columns), height.ravel(), rcond=None)[0]
    a, b, d, g, h, k, w1, w2, w4, w5 = found
    return np.array(
        [[a, d, 0, g, w1], [d, b, 0, h, w2], [0, 0, 0, 0, J], [g, h, 0, k, w4], [w1, w2, J, w4, w5]]
    )


def at_full_force(Q: np.ndarray) -> np.ndarray:
    """Return the 4x4 form of surfaces (..., 5, 5) at w = 1: P = (x, y, z, 1)."""
    fill = np.eye(5)[:, [0, 1, 2, 4]]
    fill[3, 3] = 1.0
    return fill.T @ Q @ fill


def ramp_surfaces() -> np.ndarray:
    """Return the 5x5 forms of the five caps along a ramp: indentation grows as force^(1/2)."""
    w = np.linspace(0.1, 1.0, 10)
    along = np.linspace(-1.5, 1.5, 5)
    xy = np.stack(np.meshgrid(along, along, indexing="ij"), axis=-1).reshape(-1, 2)
    x, y = xy.T
    return np.array(
        [
            fit_ramp_surface(xy, w, Q[0, 0] * x**2 + Q[1, 1] * y**2 + Q[3, 3] * np.sqrt(w)[:, None])
            for Q in caps()
        ]
    )


def fifth() -> None:
    """Print lambda_5 of the form with the grip force as fifth coordinate, and how it keeps."""
    print(f"\n{'5x5, w = part of the full force':<38}" + "".join(f"{name:>12}" for name in NAMES))
    surfaces = ramp_surfaces()
    outer, inner = np.linalg.eigvalsh(surfaces), np.linalg.eigvalsh(surfaces[:, :4, :4])
    same(
        bool(np.all(outer[:, :4] <= inner + 1e-9) and np.all(inner <= outer[:, 1:] + 1e-9)),
        "the spectra of 5x5 and 4x4 do not interlace",
    )
    fives = np.abs(outer).min(axis=1)
    fours = smallest_eigenvalue(at_full_force(surfaces)).value
    print(f"  {'min |lambda| of 5x5':<36}" + "".join(f"{value:12.4g}" for value in fives))
    print(f"  {'min |lambda| of 4x4 at w = 1':<36}" + "".join(f"{value:12.4g}" for value in fours))
    keep = np.array([0, 1, 2, 4])
    for kind in TRANSFORMATIONS:
        # a pose leaves w as it is
        poses = inverses(kind)
        M_inv = np.tile(np.eye(5), (len(poses), 1, 1))
        M_inv[:, keep[:, None], keep] = poses
        moved = np.swapaxes(M_inv, -1, -2) @ surfaces[:, None] @ M_inv
        value = np.abs(np.linalg.eigvalsh(moved)).min(axis=-1)
        print(f"  {kind:<36}" + "".join(shown(kind, value, fives)))


def main(effort: float = 1.0) -> None:
    n = repeats(2000, effort, least=30)
    line("compared", "eigenvalues of every pose of the paper's grid with those at rest")
    for form, matrices in (("full quadrics", OBJECTS), ("form (7)", caps())):
        for reading in (Reading.SMALLEST_MAGNITUDE, Reading.ALGEBRAIC_MINIMUM):
            table(form, matrices, reading)
    corrected(n)
    bounds()
    column_sums(n)
    fifth()
    least, greatest = sweep(OBJECTS[3:4], TRANSFORMATIONS["scale"]).spread[0]
    factor = greatest / least
    line("  ratio", f"scale 1 to 4 moves the ball's min |lambda| {factor:.1f} times")


if __name__ == "__main__":
    main()
