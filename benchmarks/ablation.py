"""What each group of features and each part of the recogniser adds.

The groups: a plain discriminant with all of them, and without each. The parts: the recogniser as it
is, and with taxels as they read, one covariance for all objects, no virtual grasps, of touch alone
without the patch close up, or with the opening no tilted placings. These are tested on places too:
taught with the 60 per cent of each object's grasps that lie nearest to one end or side of the pads,
and tested on the others.

Taught with the first 60 per cent of each object's grasps; tested on blocks held out within them, so
that the last 40 per cent stay unseen. ``surface`` holds the paper's idea: the pressed patch as a
quadric at two levels of the ramp, its curvatures and the eigenvalues of its matrix.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from benchmarks._grasps import recorded, simulated
from benchmarks._measure import line, repeats
from recognition.calibration import blocked_folds
from recognition.features import close_up_features, feature_groups
from recognition.features_footprint import PadGrid, pad_grid
from recognition.lda import fit_lda
from recognition.metrics import wilson_interval
from recognition.ramp import learn_rest
from recognition.ramp_levels import Levels, load_levels
from recognition.recognizers._class_spread import ClassSpread
from recognition.recognizers._evidence_fit import fit_evidence
from recognition.recognizers._telling import Rows
from recognition.splits import by_label, chronological_split
from recognition.taxel_gain import learn_taxel_gains
from recognition.virtual import TILTS_RAD, change_sides, tilt, turn

_FOLDS = 4
_CLOSE_UP = "close_up"


def parts(
    levels: Levels,
    grids: Sequence[PadGrid],
    classes: NDArray[np.int64],
    ways: Mapping[str, Sequence[NDArray[np.bool_]]],
    *,
    opening: bool,
) -> None:
    """Print how many held-out grasps the recogniser names without each of its parts."""
    n_classes = int(classes.max()) + 1

    def right(
        *,
        gains: bool = True,
        spread: bool = True,
        virtual: bool = True,
        close_up: bool = True,
        tilts: bool = True,
    ) -> str:
        describe = partial(_rows, grids=grids, opening=opening, close_up=close_up)
        counts = {
            way: sum(
                found(m, describe, gains=gains, spread=spread, virtual=virtual, tilts=tilts)
                for m in masks
            )
            for way, masks in ways.items()
        }
        return ", ".join(f"{way} {_share(counts[way], masks)}" for way, masks in ways.items())

    def found(
        held_out: NDArray[np.bool_],
        describe: Callable[[Levels], NDArray[np.float64]],
        *,
        gains: bool,
        spread: bool,
        virtual: bool,
        tilts: bool,
    ) -> int:
        evened = levels
        if gains:
            evened = learn_taxel_gains(levels.take(~held_out), grids).undo(levels)
        rows = describe(evened)
        turned = describe(change_sides(evened if opening else turn(evened)))
        nuisance = None
        if opening and tilts:
            taken = evened.take(~held_out)
            tilted = [describe(tilt(taken, grids, angle_rad)) for angle_rad in TILTS_RAD]
            nuisance = np.concatenate(tilted) - np.tile(rows[~held_out], (len(tilted), 1))
        taught = fit_evidence(
            rows[~held_out],
            classes[~held_out],
            n_classes,
            virtual=turned[~held_out] if virtual else None,
            nuisance=nuisance,
        )
        if not spread:
            taught = replace(taught, spread=_shared(taught.spread, n_classes))
        tested = Rows(
            tactile=rows[held_out][:, None], aperture=np.zeros((int(held_out.sum()), 1, 0))
        )
        scores = taught.tell(tested, np.zeros((1, 1))).scores
        return int(np.sum(scores.argmax(axis=1) == classes[held_out]))

    line("    the recogniser", right())
    line("    taxels as they read", right(gains=False))
    line("    one covariance", right(spread=False))
    line("    no virtual grasps", right(virtual=False))
    if not opening:
        line("    not close up", right(close_up=False))
    else:
        line("    no tilted placings", right(tilts=False))


def places(
    levels: Levels, grids: Sequence[PadGrid], classes: NDArray[np.int64]
) -> list[NDArray[np.bool_]]:
    """Return masks of the grasps held out: of each object those at one end or side of the pads."""
    centres = np.zeros((len(classes), 2))
    for m, grid in zip(levels.maps, grids, strict=True):
        load = np.maximum(m[:, -1], 0.0)
        centres += load @ grid.xy_mm / np.maximum(load.sum(axis=1), 1e-9)[:, None]
    masks = []
    for along in (centres[:, 0], -centres[:, 0], centres[:, 1], -centres[:, 1]):
        held_out = np.zeros(len(classes), dtype=np.bool_)
        for label in np.unique(classes):
            rows = np.flatnonzero(classes == label)
            held_out[rows[np.argsort(along[rows])[-round(0.4 * len(rows)) :]]] = True
        masks.append(held_out)
    return masks


def _share(count: int, masks: Sequence[NDArray[np.bool_]]) -> str:
    n = int(sum(mask.sum() for mask in masks))
    low, high = wilson_interval(count, n)
    return f"{100 * count / n:.1f} % ({100 * low:.1f}-{100 * high:.1f})"


def _rows(
    levels: Levels, grids: Sequence[PadGrid], *, opening: bool, close_up: bool
) -> NDArray[np.float64]:
    groups = feature_groups(levels, grids)
    names = [name for name in groups if opening or name != "aperture"]
    parts = [groups[name] for name in names]
    if close_up and not opening:
        parts.append(close_up_features(levels, grids))
    return np.concatenate(parts, axis=1)


def _shared(spread: ClassSpread, n_classes: int) -> ClassSpread:
    """Return the one covariance that all classes share."""
    return ClassSpread(
        axes=np.zeros((n_classes, spread.axes.shape[1])),
        origin=np.zeros(n_classes),
        first=np.arange(n_classes),
        across=np.ones(n_classes),
        log_volume=np.zeros(n_classes),
    )


def main(effort: float = 1.0) -> None:
    grasps = recorded()
    if grasps is None:
        grasps = simulated(2, repeats(20, effort, least=8))
    train = [
        g for members in by_label(chronological_split(grasps, 0.6)[0]).values() for g in members
    ]
    classes = np.unique([g.label for g in train], return_inverse=True)[1]
    rest = learn_rest(train)
    levels = load_levels(train, rest)
    grids = [pad_grid(rest.pads, p) for p in rest.gripping]
    groups = feature_groups(levels, grids) | {_CLOSE_UP: close_up_features(levels, grids)}
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
    both = [name for name in groups if name != _CLOSE_UP]
    for title, names in (("touch", touch), ("touch and opening", both)):
        every = right(names)
        low, high = wilson_interval(every, n)
        line(f"  {title}", f"{100 * every / n:.1f} % ({100 * low:.1f}-{100 * high:.1f})")
        for name in names:
            without = right([other for other in names if other != name])
            alone = right([name])
            figures = f"without it {100 * without / n:.1f} %, alone {100 * alone / n:.1f} %"
            line(f"    {name}", f"{figures}; {groups[name].shape[1]} features")
    ways = {"blocks": folds, "places": places(levels, grids, classes)}
    for title, opening in (("parts, touch", False), ("parts, touch and opening", True)):
        line(f"  {title}", "")
        parts(levels, grids, classes, ways, opening=opening)
    wrong = n - right([name for name in touch if name != "surface"])
    times = max(wrong, 0.5) / max(n - right(touch), 0.5)
    line("  ratio", f"touch errs {times:.2f} times as often without the quadric surfaces")


if __name__ == "__main__":
    main()
