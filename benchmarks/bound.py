"""What limits a recogniser: what it would still confuse if it had been taught a hundred times more.

Simulated grasps can be had in any number, so there it is done: objects of nearly the same size and
form, touch alone, 5 of each taught and then 500, the same grasps tested. Of recorded grasps there
are no more than there are: within the first 60 per cent (the rest is never looked at here) random
ones of each object are taught and the others tested, and the errors are carried on to a hundred
times the data by the power law that fits them (Cortes et al. 1994). Grasps that teach and test then
come from the same minutes: the difference to what `evaluate` finds on later grasps is what the
placing of the objects has moved meanwhile, and no number of grasps from earlier minutes mends it.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from benchmarks._grasps import recorded, share_right
from benchmarks._measure import line, repeats
from benchmarks._posed_grasps import Sensing, draw_placing, posed_grasp
from recognition.grasp import Grasp
from recognition.metrics import wilson_interval
from recognition.recognizers import DEFAULT_TRAINER, make_trainer
from recognition.splits import by_label, chronological_split

_TIMES = 100
_TAUGHT = (3, 5, 8, 11)
_ALIKE = {
    f"{form} {diameter:g} mm": text.format(diameter)
    for form, text in (
        ("sphere", "sphere:diameter={:g}mm"),
        ("cylinder", "cylinder:diameter={:g}mm,length=16mm"),
    )
    for diameter in (8.0, 9.0, 10.0)
}
_TOUCH_ALONE = Sensing(aperture_known=False)
_SLOPES = np.linspace(0.2, 2.0, 37)


def power_law(n: Sequence[int], error: Sequence[float]) -> tuple[float, float, float]:
    """Return (a, b, c) of the error a + b * n**-c that fits best, a and b at least 0."""
    size, wanted = np.asarray(n, dtype=np.float64), np.asarray(error, dtype=np.float64)
    fits: list[tuple[float, float, NDArray[np.float64]]] = []
    for slope in _SLOPES:
        columns = np.column_stack([np.ones_like(size), size**-slope])
        found, residual = nnls(columns, wanted)
        fits.append((float(residual), float(slope), found))
    _, slope, (floor, factor) = min(fits, key=lambda fit: fit[0])
    return float(floor), float(factor), slope


def random_split(
    grasps: Sequence[Grasp], n: int, rng: np.random.Generator
) -> tuple[list[Grasp], list[Grasp]]:
    """Return n random grasps of each label that teach, and the others, that test."""
    train: list[Grasp] = []
    test: list[Grasp] = []
    for members in by_label(grasps).values():
        order = rng.permutation(len(members))
        train += [members[i] for i in order[:n]]
        test += [members[i] for i in order[n:]]
    return train, test


def simulated(effort: float) -> None:
    """Print what 5 and 500 taught grasps of objects that are alike give on the same tests."""
    least, n_test = repeats(5, effort, least=3), repeats(50, effort, least=2)
    most = max(least + 1, repeats(_TIMES * least, effort))
    rng = np.random.default_rng(7)
    grasps = {
        label: [
            posed_grasp(label, text, draw_placing(rng), 10_000 * k + i, _TOUCH_ALONE)
            for i in range(most + n_test)
        ]
        for k, (label, text) in enumerate(_ALIKE.items())
    }
    test = [grasp for members in grasps.values() for grasp in members[most:]]
    line("compared", f"6 simulated objects 1 mm apart, touch alone, {len(test)} grasps tested")
    share = {}
    for n in (least, most):
        taught = [grasp for members in grasps.values() for grasp in members[:n]]
        found = make_trainer(DEFAULT_TRAINER, use_aperture=False).fit(taught)
        share[n] = share_right(found, test)
        low, high = wilson_interval(round(share[n] * len(test)), len(test))
        line(f"  {n} taught", f"{100 * share[n]:.1f} % right ({100 * low:.1f} to {100 * high:.1f})")
    wrong = {n: max(1.0 - value, 0.5 / len(test)) for n, value in share.items()}
    line("  ratio", f"the few err {wrong[least] / wrong[most]:.1f} times as often as the many")


def extrapolated(grasps: Sequence[Grasp], effort: float) -> None:
    """Print the errors of random splits and where their power law ends."""
    first, _ = chronological_split(grasps, 0.6)
    of_label = {k: v for k, v in by_label(first).items() if len(v) > _TAUGHT[-1]}
    early = [grasp for members in of_label.values() for grasp in members]
    line("compared", f"{len(early)} recorded grasps of {len(of_label)} objects, first 60 %")
    for use_aperture in (False, True):
        errors = []
        for n in _TAUGHT:
            shares, tested = [], 0
            for turn in range(repeats(4, effort)):
                train, test = random_split(early, n, np.random.default_rng(turn))
                taught = make_trainer(DEFAULT_TRAINER, use_aperture=use_aperture).fit(train)
                shares.append(share_right(taught, test))
                tested += len(test)
            errors.append(1.0 - float(np.mean(shares)))
            line(f"  {n} taught", f"{100 * (1 - errors[-1]):.1f} % right of {tested}")
        floor, factor, slope = power_law(_TAUGHT, errors)
        many = _TIMES * _TAUGHT[-1]
        bound = floor + factor * many**-slope
        what = "touch and opening" if use_aperture else "touch alone"
        line(
            f"  {many} taught",
            f"{what}: {100 * (1 - bound):.1f} % right, if "
            f"{100 * floor:.1f} + {100 * factor:.0f} n^-{slope:.2f} per cent of errors goes on",
        )


def main(effort: float = 1.0) -> None:
    simulated(effort)
    grasps = recorded()
    if grasps is not None:
        extrapolated(grasps, effort)


if __name__ == "__main__":
    main()
