"""What each group of features adds: a plain discriminant with all groups, and without each.

Taught with the first 60 per cent of each object's grasps; tested on blocks held out within them, so
that the last 40 per cent stay unseen. ``surface`` holds the paper's idea: the pressed patch as a
quadric at two levels of the ramp, its curvatures and the eigenvalues of its matrix.
"""

import numpy as np

from benchmarks._grasps import recorded, simulated
from benchmarks._measure import line, repeats
from recognition.calibration import blocked_folds
from recognition.features import feature_groups
from recognition.features_footprint import pad_grid
from recognition.lda import fit_lda
from recognition.metrics import wilson_interval
from recognition.ramp import learn_rest
from recognition.ramp_levels import load_levels
from recognition.splits import by_label, chronological_split

_FOLDS = 4


def main(effort: float = 1.0) -> None:
    grasps = recorded()
    if grasps is None:
        grasps = simulated(2, repeats(20, effort, least=8))
    train = [
        g for members in by_label(chronological_split(grasps, 0.6)[0]).values() for g in members
    ]
    classes = np.unique([g.label for g in train], return_inverse=True)[1]
    rest = learn_rest(train)
    groups = feature_groups(
        load_levels(train, rest), [pad_grid(rest.pads, p) for p in rest.gripping]
    )
    folds = blocked_folds(classes, _FOLDS)

    def right(names: list[str]) -> int:
        rows = np.concatenate([groups[name] for name in names], axis=1)
        found = 0
        for held_out in folds:
            lda = fit_lda(rows[~held_out], classes[~held_out], int(classes.max()) + 1)
            found += int(np.sum(lda.distances(rows[held_out]).argmin(axis=1) == classes[held_out]))
        return found

    n = int(np.any(np.stack(folds), axis=0).sum())
    line("compared", f"{int(classes.max()) + 1} objects, {n} grasps in {_FOLDS} held-out blocks")
    touch = [name for name in groups if name != "aperture"]
    for title, names in (("touch", touch), ("touch and opening", [*touch, "aperture"])):
        every = right(names)
        low, high = wilson_interval(every, n)
        line(f"  {title}", f"{100 * every / n:.1f} % ({100 * low:.1f}-{100 * high:.1f})")
        for name in names:
            without = right([other for other in names if other != name])
            alone = right([name])
            figures = f"without it {100 * without / n:.1f} %, alone {100 * alone / n:.1f} %"
            line(f"    {name}", f"{figures}; {groups[name].shape[1]} features")
    wrong = n - right([name for name in touch if name != "surface"])
    times = max(wrong, 0.5) / max(n - right(touch), 0.5)
    line("  ratio", f"touch errs {times:.2f} times as often without the quadric surfaces")


if __name__ == "__main__":
    main()
