"""Plain methods of scikit-learn against the recognizers of the product.

``python -m benchmarks comparators FILE`` names the last 40 per cent in time of each object's grasps
in a data set, as ``tactile-cell model evaluate`` does. Discriminant and trees get all features of
the default recognizer; the others have their own, from the patch of each pad under full load. A
small grid is searched with blocks in time of the grasps that teach.

The default recognizer also names the tested grasps under simulated drifts.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from sklearn.base import BaseEstimator, ClassifierMixin, clone
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis
from sklearn.ensemble import ExtraTreesClassifier
from sklearn.impute import SimpleImputer
from sklearn.model_selection import GridSearchCV
from sklearn.neighbors import KNeighborsClassifier
from sklearn.pipeline import Pipeline
from sklearn.preprocessing import StandardScaler

from benchmarks._measure import line, repeats, share
from benchmarks.recognition._grasps import asked, figures, followed
from cell.recording.dataset import read_dataset
from recognition.drift.drift import Drift, drift_text
from recognition.evaluation.splits import a_day_later, chronological_split
from recognition.features import PadGrid, features_of, pad_grid, pressed
from recognition.grasp import Grasp
from recognition.ramp.ramp import learn_rest, load_levels
from recognition.recognizers import make_trainer, trainer_names
from recognition.statistics.calibration import blocked_folds

TAUGHT_SHARE = 0.6
"""First part in time of each object's grasps, which teaches."""
_FOLDS = 3
"""Blocks in time of the grasps that teach; each is held out in turn."""

Array = NDArray[np.float64]


def centred(patch: Array, grid: PadGrid) -> Array:
    """Return the pressures of a pad, moved so that the centre of the load is in its middle.

    They are interpolated, and 0 one pitch outside the pad.
    """
    centre_mm = np.average(grid.xy_mm, axis=0, weights=patch if patch.any() else None)
    points_mm = grid.xy_mm + centre_mm - grid.xy_mm.mean(axis=0)
    step_mm = (grid.xy_mm[-1] - grid.xy_mm[0]) / np.maximum(np.array(grid.shape) - 1, 1)
    step_mm = np.where(step_mm == 0.0, grid.pitch_mm, step_mm)
    at = (points_mm - grid.xy_mm[0]) / step_mm + 1.0
    padded = np.pad(patch.reshape(grid.shape), 1)
    return map_coordinates(padded, np.moveaxis(at, -1, 0), order=1, mode="constant")


class Comparator(ClassifierMixin, BaseEstimator):
    """A method: ``fit(grasps, labels)``, ``predict(grasps)``.

    It has the features of the product, or with ``raw`` the centred pressures of each gripping pad.
    """

    def __init__(
        self,
        classifier: BaseEstimator,
        grid: Mapping[str, Sequence[object]],
        *,
        raw: bool = False,
        opening: bool = False,
    ) -> None:
        self.classifier, self.grid = classifier, grid
        self.raw, self.opening = raw, opening

    def fit(self, grasps: Sequence[Grasp], labels: Sequence[str]) -> "Comparator":
        """Teach with the parameters that are best on blocks in time of each object's grasps."""
        order = np.argsort([grasp.start_ms for grasp in grasps], kind="stable")
        ordered, names = [grasps[i] for i in order], np.array(labels)[order]
        masks = blocked_folds(np.unique(names, return_inverse=True)[1], _FOLDS)
        folds = [(np.flatnonzero(~held), np.flatnonzero(held)) for held in masks]
        self.rest_ = learn_rest(ordered)
        scaler = StandardScaler(with_mean=not self.raw, with_std=not self.raw)
        steps = (SimpleImputer(keep_empty_features=True), scaler, self.classifier)
        model = Pipeline(list(zip(("filler", "scaler", "model"), steps, strict=True)))
        grid = {f"model__{name}": values for name, values in self.grid.items()}
        self.search_ = GridSearchCV(model, grid, cv=folds, error_score="raise")
        self.search_.fit(self._rows(ordered), names)
        return self

    def predict(self, grasps: Sequence[Grasp]) -> NDArray[np.str_]:
        """Return the likeliest label of each grasp."""
        return self.search_.predict(self._rows(grasps))

    def _rows(self, grasps: Sequence[Grasp]) -> Array:
        """Return the features (n, F)."""
        levels, rest = load_levels(grasps, self.rest_), self.rest_
        if not self.raw:
            return features_of(levels, rest, opening=self.opening)
        of_pads = []
        for column, pad in enumerate(rest.gripping):
            patches = pressed(levels.maps[column][:, -1], levels.noise[:, -1, column])
            grid = pad_grid(rest.pads, pad)
            of_pads.append([centred(patch, grid) for patch in patches])
        return np.concatenate(of_pads, axis=1)


METHODS = {
    "discriminant": Comparator(
        LinearDiscriminantAnalysis(solver="lsqr"), {"shrinkage": ("auto", 0.03, 0.3)}
    ),
    "extra_trees": Comparator(
        ExtraTreesClassifier(300, random_state=0),
        {"max_features": ("sqrt", 0.3), "min_samples_leaf": (1, 2, 4)},
    ),
    "raw_neighbours": Comparator(KNeighborsClassifier(), {"n_neighbors": (1, 3, 5)}, raw=True),
}
DRIFTS = (Drift(gains=(0.7,), aperture_offset_m=-4e-3), Drift(gains=(0.7, 0.9)))
"""Drifts: one that the recognizer assumes, and unequal gains of the fingers, which it does not."""
WITH_OPENING = ("force_ramp", "discriminant", "extra_trees")


def named(
    name: str, opening: bool, train: Sequence[Grasp], test: Sequence[Grasp], effort: float
) -> str:
    """Return how many of the tested grasps a method names rightly, as text."""
    chosen, truth = "", [grasp.label for grasp in test]
    if name in METHODS:
        method = clone(METHODS[name])
        grid = {key: values[: repeats(len(values), effort)] for key, values in method.grid.items()}
        method.set_params(opening=opening, grid=grid)
        method.fit(train, [grasp.label for grasp in train])
        names = method.predict(test).tolist()
        best = {key.removeprefix("model__"): v for key, v in method.search_.best_params_.items()}
        chosen = "; " + ", ".join(f"{key} {value}" for key, value in best.items())
    else:
        recognizer = make_trainer(name, use_aperture=opening).fit(train)
        names = [recognizer.posterior(grasp).best for grasp in test]
    right = sum(answer == label for answer, label in zip(names, truth, strict=True))
    return f"{share(right, len(truth))} of {len(truth)}{chosen}"


def main(effort: float = 1.0, file: str | None = None) -> None:
    if file is None:
        line("compared", "nothing: name a data set of labelled grasps after `comparators`")
        return
    train, test = chronological_split(read_dataset(file), TAUGHT_SHARE)
    n_objects = len({grasp.label for grasp in train})
    line("compared", f"{n_objects} objects, {len(train)} grasps teach, {len(test)} test")
    cases = [(name, False) for name in (*trainer_names(), *METHODS)]
    for name, opening in [*cases, *((name, True) for name in WITH_OPENING)]:
        what = "with opening" if opening else "touch alone"
        line(f"  {name}, {what}", named(name, opening, train, test, effort))
    taught = make_trainer().fit(train)
    for drift in DRIFTS:
        moved = [a_day_later(drift.apply(grasp)) for grasp in test]
        line(f"  {drift_text(drift)}, each alone", figures(asked(taught, moved)))
        line("  ... followed", figures(followed(taught, moved)[0]))
