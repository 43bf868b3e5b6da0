"""What of the paper's invariance claim holds, per transformation, over the paper's grid.

The five objects stand as full quadrics (mm, k = -1) and in the form (7): the cap that each shows to
a pad, in counts. A cap's height is that of a paraboloid of the object's radii pressed with 5 N into
foam of 150 kPa and 3 mm, the ball's being 200 counts. Then equations (4) to (10) in numbers: the
semidefinite bound against eigvalsh, and column sums against the true product M^-1 P; and the 5x5
form of the conclusions, fitted along a force ramp.
"""

import numpy as np

from benchmarks._measure import line, repeats, same
from benchmarks.paper.infimum import (
    Pencil,
    approach_infimum,
    printed_image,
    printed_pencil,
    sdp_bound,
    substituted_pencil,
    true_image,
)
from benchmarks.paper.invariants import TRANSFORMATIONS, change_over, corrected_eigenvalue
from benchmarks.paper.spectrum_fifth import at_fifth, carry, fit_ramp_surface, interlacing
from benchmarks.paper.sweep import OBJECTS
from benchmarks.paper.sweep_full import sweep_summary
from recognition.errors import QuadricError
from recognition.quadric.eigen import Reading, smallest_eigenvalue
from recognition.quadric.quadric import (
    by_inverse,
    height_field_matrix,
    rotation_xyz,
    scaling,
    translation,
)
from recognition.quadric.sweep import points
from recognition.quadric.trajectory import PAPER_SWEEP, Axes, SweepSettings

NAMES = ("oval", "cylinder", "box", "ball", "dumbbell")
# radii of curvature of the side that a pad meets, mm, from the semi-axes of `OBJECTS`
_RADII_MM = (
    (49 / 5.85, 49 / 5.85),
    (3.0, 100.0**2 / 3.0),
    (5.0, 7.95**2 / 5.0),
    (4.75, 4.75),
    (5.0, -(6.5**2) / 5.0),
)
_FORCE_N, _FOAM_N_MM3, _BALL_COUNTS = 5.0, 0.150 / 3.0, 200.0


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
    changes = {}
    for kind, settings in TRANSFORMATIONS.items():
        row = [change_over(Q, settings, reading) for Q in matrices]
        changes[kind] = row
        shown = [
            f"{change.factor:11.3f}x"
            if "scale" in kind or "loops" in kind
            else f"{change.relative:12.1e}"
            for change in row
        ]
        print(f"  {kind:<36}" + "".join(shown))
    print(f"  {'value at rest':<36}" + "".join(f"{c.at_rest:12.4g}" for c in row))
    same(
        all(change.relative < 1e-8 for change in changes["rotation"]),
        "rotation about the origin changes an eigenvalue",
    )


def full_product(matrices: np.ndarray, effort: float) -> None:
    settings = SweepSettings(
        translation=PAPER_SWEEP.translation[:: 1 if effort >= 1.0 else 8],
        translation_axes=Axes.SEPARATE,
        rotation_axes=Axes.SEPARATE,
        max_evaluations=1_000_000_000,
    )
    found = [sweep_summary(Q, [1e-9, 1e9], settings) for Q in matrices]
    print(
        f"  {f'full product, {settings.n_evaluations:,}':<36}"
        + "".join(f"{one.greatest / one.least:11.3f}x" for one in found)
    )


def corrected(n: int) -> None:
    """Print by how much the corrected feature changes over poses of the grid."""
    rng = np.random.default_rng(2)
    M_inv = inverses("all three loops")
    M_inv = M_inv[rng.choice(len(M_inv), min(n, len(M_inv)), replace=False)]
    widths = []
    for Q in OBJECTS:
        at_rest = float(corrected_eigenvalue(Q).value)
        moved = corrected_eigenvalue(by_inverse(Q, M_inv)).value
        widths.append(np.ptp(moved) / at_rest)
    print(
        f"\n{'corrected feature, ' + str(len(M_inv)) + ' poses':<38}"
        + "".join(f"{width:12.1e}" for width in widths)
    )


def inverses(kind: str) -> np.ndarray:
    """Return M^-1 of every pose of one kind, (n, 4, 4)."""
    settings = TRANSFORMATIONS[kind]
    shift = points(settings.translation, 2, separate=settings.translation_axes is Axes.SEPARATE)
    turn = points(settings.angle_rad, 3, separate=settings.rotation_axes is Axes.SEPARATE)
    back = translation(np.column_stack([-shift, np.zeros(len(shift))]))
    turned = np.swapaxes(rotation_xyz(turn), -1, -2) @ back[:, None]
    return (scaling(1.0 / settings.scale)[:, None, None] @ turned).reshape(-1, 4, 4)


def column_sums(n: int) -> None:
    """Print equations (8) to (10) against the true product."""
    rng = np.random.default_rng(3)
    P = np.column_stack([rng.uniform(-5, 5, (50, 3)), np.ones(50)])
    heads = ("right for", "median off", "worst off", "undefined", "(9) keeps inf", "true keeps inf")
    print(f"\n{'eq. (8)-(10), M^-1 P':<26}" + "".join(f"{head:>15}" for head in heads))
    Q = caps()[3]
    infimum = sdp_bound(Pencil(P=Q, N=np.eye(4))).feasible
    for kind in TRANSFORMATIONS:
        M_inv = inverses(kind)
        if len(M_inv) > n:
            M_inv = M_inv[rng.choice(len(M_inv), n, replace=False)]
        printed = printed_image(M_inv[:, None], P)
        true = true_image(M_inv[:, None], P)
        off = np.linalg.norm(printed - true, axis=-1) / np.linalg.norm(true, axis=-1)
        off = off.max(axis=1)
        kept, undefined, true_kept = 0, 0, 0
        for one in M_inv[: n // 10]:
            try:
                bound = sdp_bound(printed_pencil(Q, one)).feasible
            except QuadricError:
                undefined += 1
            else:
                kept += abs(bound / infimum - 1.0) < 1e-6
            true_bound = sdp_bound(substituted_pencil(Q, one)).feasible
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
            pencil = Pencil(P=Q, N=np.eye(4))
            bound, reached = sdp_bound(pencil), approach_infimum(pencil)
            lowest = float(np.linalg.eigvalsh(Q)[0])
            same(
                abs(bound.feasible - lowest) < 1e-12 * np.abs(Q).max(),
                f"the bound of the {name} is not its smallest eigenvalue",
            )
            same(reached.value >= lowest - 1e-9, "a point lies below the infimum")
            print(
                f"  {name + ', ' + form:<24}{bound.feasible:22.15g}{lowest:22.15g}"
                f"{reached.value:22.15g}{np.linalg.norm(reached.x):9.2g}"
            )


def ramp_surfaces() -> np.ndarray:
    """Return the 5x5 forms of the five caps along a ramp: indentation grows as force^(1/2)."""
    w = np.linspace(0.1, 1.0, 10)
    along = np.linspace(-1.5, 1.5, 5)
    xy = np.stack(np.meshgrid(along, along, indexing="ij"), axis=-1).reshape(-1, 2)
    x, y = xy.T
    found = []
    for Q in caps():
        falls = Q[0, 0] * x**2 + Q[1, 1] * y**2
        found.append(fit_ramp_surface(xy, w, falls + Q[3, 3] * np.sqrt(w)[:, None]))
    return np.array(found)


def fifth() -> None:
    """Print lambda_5 of the form with the grip force as fifth coordinate, and how it keeps."""
    print(f"\n{'5x5, w = part of the full force':<38}" + "".join(f"{name:>12}" for name in NAMES))
    surfaces = ramp_surfaces()
    same(interlacing(surfaces).min() > -1e-9, "the spectra of 5x5 and 4x4 do not interlace")
    fives = smallest_eigenvalue(surfaces).value
    fours = smallest_eigenvalue(np.array([at_fifth(Q, 1.0) for Q in surfaces])).value
    print(f"  {'min |lambda| of 5x5':<36}" + "".join(f"{value:12.4g}" for value in fives))
    print(f"  {'min |lambda| of 4x4 at w = 1':<36}" + "".join(f"{value:12.4g}" for value in fours))
    for kind in TRANSFORMATIONS:
        M_inv = carry(inverses(kind))
        shown = []
        for Q in surfaces:
            moved = np.swapaxes(M_inv, -1, -2) @ Q @ M_inv
            value = np.abs(np.linalg.eigvalsh(moved)).min(axis=-1)
            factor = "scale" in kind or "loops" in kind
            shown.append(
                f"{value.max() / value.min():11.3f}x"
                if factor
                else f"{np.ptp(value) / value[0]:12.1e}"
            )
        print(f"  {kind:<36}" + "".join(shown))


def main(effort: float = 1.0) -> None:
    n = repeats(2000, effort, least=30)
    line("compared", "eigenvalues of every pose of the paper's grid with those at rest")
    for form, matrices in (("full quadrics", OBJECTS), ("form (7)", caps())):
        for reading in (Reading.SMALLEST_MAGNITUDE, Reading.ALGEBRAIC_MINIMUM):
            table(form, matrices, reading)
            if reading is Reading.SMALLEST_MAGNITUDE:
                full_product(matrices, effort)
    corrected(n)
    bounds()
    column_sums(n)
    fifth()
    factor = change_over(OBJECTS[3], TRANSFORMATIONS["scale"]).factor
    line("  ratio", f"scale 1 to 4 moves the ball's min |lambda| {factor:.1f} times")


if __name__ == "__main__":
    main()
