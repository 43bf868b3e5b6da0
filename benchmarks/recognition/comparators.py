"""Methods that the paper names, and plain ones, against the recognizers of the product.

``python -m benchmarks comparators FILE`` names the last 40 per cent in time of each object's grasps
in a data set, as ``tactile-cell model evaluate`` does. Discriminant and trees get all features of
the default recognizer; the others have their own, from the patch of each pad under full load. A
small grid is searched with blocks in time of the grasps that teach.

The default recognizer also names the tested grasps under simulated drifts.
"""

import warnings
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from sklearn.base import BaseEstimator, ClassifierMixin, clone
from sklearn.discriminant_analysis import LinearDiscriminantAnalysis
from sklearn.ensemble import ExtraTreesClassifier
from sklearn.exceptions import ConvergenceWarning
from sklearn.impute import SimpleImputer
from sklearn.model_selection import GridSearchCV
from sklearn.neighbors import KNeighborsClassifier
from sklearn.neural_network import MLPClassifier
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
_ANGLES, _VERTICES, _STEP_MM = 32, 8, 0.25
"""Directions of an outline, vertices of its polygon, and steps of the search for it."""
_FULL_SCALE_MM = 3.0
"""Depth of a taxel at full scale: the thickness of the paper's foam."""
_SECTION, _REACH = np.linspace(-1.0, 1.0, 21), 1.6
"""Points of a section as shares of its reach, which is so many deviations of the load along it."""

Array = NDArray[np.float64]
PatchFeatures = Callable[[Array, PadGrid, float], Array]
"""From the patch of a pad (n_taxels,), its grid and the share of the outline to features (F,)."""


def centroid_mm(patch: Array, grid: PadGrid) -> Array:
    """Return the centre of the load (2,), that of the pad for an empty patch."""
    return np.average(grid.xy_mm, axis=0, weights=patch if patch.any() else None)


def sample_mm(patch: Array, grid: PadGrid, points_mm: Array) -> Array:
    """Return a patch, interpolated at points (..., 2); 0 one pitch outside the pad."""
    step_mm = (grid.xy_mm[-1] - grid.xy_mm[0]) / np.maximum(np.array(grid.shape) - 1, 1)
    step_mm = np.where(step_mm == 0.0, grid.pitch_mm, step_mm)
    at = (points_mm - grid.xy_mm[0]) / step_mm + 1.0
    padded = np.pad(patch.reshape(grid.shape), 1)
    return map_coordinates(padded, np.moveaxis(at, -1, 0), order=1, mode="constant")


def outline_mm(patch: Array, grid: PadGrid, share: float) -> Array:
    """Return the farthest points with a share of the peak, in each direction from the centroid.

    An empty patch has equal radii.
    """
    angle = np.arange(_ANGLES) * (2.0 * np.pi / _ANGLES)
    rays = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    if not patch.any():
        return rays
    longest_mm = np.hypot(*(np.ptp(grid.xy_mm, axis=0) + 2.0 * grid.pitch_mm))
    steps_mm = np.arange(0.0, longest_mm, _STEP_MM)
    points_mm = centroid_mm(patch, grid) + steps_mm[:, None, None] * rays
    above = sample_mm(patch, grid, points_mm) - share * patch.max()
    above[0], above[-1] = np.maximum(above[0], 1e-9), -1e-9
    last = len(steps_mm) - 1 - np.argmax(above[::-1] > 0.0, axis=0)
    inner, outer = (above[n, np.arange(_ANGLES)] for n in (last, last + 1))
    return (_STEP_MM * (last + inner / (inner - outer)))[:, None] * rays


def radius_vector(patch: Array, grid: PadGrid, share: float) -> Array:
    """Return the radii of the outline over their mean, from its long axis on.

    After the paper's refs. [6, 7, 12]: without position, size and rotation.
    """
    radii = np.hypot(*outline_mm(patch, grid, share).T)
    angle = np.arange(_ANGLES) * (2.0 * np.pi / _ANGLES)
    axis = 0.5 * np.angle(np.sum(radii * np.exp(2j * angle)))
    turned = np.roll(radii / radii.mean(), -round(axis * _ANGLES / (2.0 * np.pi)))
    first, second = np.split(turned, 2)
    return turned if first.sum() >= second.sum() else np.concatenate([second, first])


def contour(patch: Array, grid: PadGrid, share: float) -> Array:
    """Return edge lengths and turning angles of the outline's polygon, from its longest edge on.

    After Ng, the paper's refs. [7, 8]. The vertex with the least bend is removed repeatedly.
    """
    points = outline_mm(patch, grid, share)
    while len(points) > _VERTICES:
        one, two = points - np.roll(points, 1, axis=0), np.roll(points, -1, axis=0) - points
        bend = np.abs(one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0])
        points = np.delete(points, np.argmin(bend), axis=0)
    edge = (np.roll(points, -1, axis=0) - points) @ np.array([1.0, 1j])
    edge = np.roll(edge, -np.argmax(np.abs(edge)))
    turn = np.angle(np.roll(edge, -1) / edge) / np.pi
    return np.concatenate([np.abs(edge) / np.abs(edge).sum(), turn])


def curve_invariants(curvature: Array, slope: Array) -> Array:
    """Return the invariants of a conic: (I at each point, m, mean of I + m |k|^(-2/3)).

    After Ibrayev and Jia, the paper's refs. [3, 4]: with the curvature k and its derivative k' over
    the arc, I = |k|^(2/3) (1 + (k' / 3 k^2)^2) is the same at all points of a parabola. On an
    ellipse or hyperbola I + m |k|^(-2/3) is. m is by least squares; 0 for points of one curvature.
    """
    k = np.maximum(np.abs(curvature), 1e-6)
    each, far = k ** (2 / 3) * (1.0 + (slope / (3.0 * k**2)) ** 2), k ** (-2 / 3)
    off = far - far.mean()
    m = -(off @ each) / (off @ off) if off @ off > (1e-6 * far.mean()) ** 2 else 0.0
    return np.array([*each, m, each.mean() + m * far.mean()])


def sections(patch: Array, grid: PadGrid, share: float) -> Array:
    """Return invariants of cubics, fitted to the sections along long and short axis of a patch."""
    del share
    centre = centroid_mm(patch, grid)
    off = grid.xy_mm - centre
    weight = patch / max(patch.sum(), 1e-12)
    variance, axes = np.linalg.eigh((weight * off.T) @ off + np.diag(grid.pitch_mm**2 / 12.0))
    rows = []
    for axis in (1, 0):
        reach_mm = _REACH * np.sqrt(variance[axis])
        points_mm = centre + reach_mm * _SECTION[:, None] * axes[:, axis]
        height_mm = _FULL_SCALE_MM * sample_mm(patch, grid, points_mm)
        cubic = np.polynomial.Polynomial.fit(reach_mm * _SECTION, height_mm, 3).convert()
        x_mm = 0.5 * reach_mm * np.array([-1.0, 0.0, 1.0])
        first, second, third = (cubic.deriv(n)(x_mm) for n in (1, 2, 3))
        stretch = 1.0 + first**2
        k = second / stretch**1.5
        slope = (third * stretch - 3.0 * first * second**2) / stretch**3
        _, middle, _, m, conic = curve_invariants(k, slope)
        strong = 10.0 * np.array([k[1], k[0] + k[2], abs(k[2] - k[0]), abs(slope[1])])
        sixth = 100.0 * abs(third[1]) / 6.0
        rows.append([*np.arcsinh([*strong, m, conic, sixth]), np.log(middle)])
    return np.concatenate(rows)


def centred(patch: Array, grid: PadGrid, share: float) -> Array:
    """Return the pressures of a pad, moved so that the centre of the load is in its middle."""
    del share
    off_mm = centroid_mm(patch, grid) - grid.xy_mm.mean(axis=0)
    return sample_mm(patch, grid, grid.xy_mm + off_mm)


class Comparator(ClassifierMixin, BaseEstimator):
    """A method: ``fit(grasps, labels)``, ``predict(grasps)``.

    It has features of each gripping pad's patch, or with None those of the product. The outline of
    a patch is where the pressure has fallen to a share of its peak.
    """

    def __init__(
        self,
        of_patch: PatchFeatures | None,
        classifier: BaseEstimator,
        grid: Mapping[str, Sequence[object]],
        *,
        outlines: Sequence[float] = (0.3,),
        scaled: bool = True,
        opening: bool = False,
    ) -> None:
        self.of_patch, self.classifier, self.grid = of_patch, classifier, grid
        self.outlines, self.scaled, self.opening = outlines, scaled, opening

    def fit(self, grasps: Sequence[Grasp], labels: Sequence[str]) -> "Comparator":
        """Teach with the parameters that are best on blocks in time of each object's grasps."""
        order = np.argsort([grasp.start_ms for grasp in grasps], kind="stable")
        ordered, names = [grasps[i] for i in order], np.array(labels)[order]
        masks = blocked_folds(np.unique(names, return_inverse=True)[1], _FOLDS)
        folds = [(np.flatnonzero(~held), np.flatnonzero(held)) for held in masks]
        self.rest_ = learn_rest(ordered)
        scaler = StandardScaler(with_mean=self.scaled, with_std=self.scaled)
        steps = (SimpleImputer(keep_empty_features=True), scaler, self.classifier)
        model = Pipeline(list(zip(("filler", "scaler", "model"), steps, strict=True)))
        grid = {f"model__{name}": values for name, values in self.grid.items()}
        searches = {}
        with warnings.catch_warnings():
            # A network is not trained to its end: that prevents overfitting.
            warnings.simplefilter("ignore", ConvergenceWarning)
            for outline in self.outlines:
                searches[outline] = GridSearchCV(model, grid, cv=folds, error_score="raise")
                searches[outline].fit(self._rows(ordered, outline), names)
        self.outline_ = max(searches, key=lambda outline: searches[outline].best_score_)
        self.search_ = searches[self.outline_]
        return self

    def predict(self, grasps: Sequence[Grasp]) -> NDArray[np.str_]:
        """Return the likeliest label of each grasp."""
        return self.search_.predict(self._rows(grasps, self.outline_))

    def _rows(self, grasps: Sequence[Grasp], outline: float) -> Array:
        """Return the features (n, F)."""
        levels, rest = load_levels(grasps, self.rest_), self.rest_
        if self.of_patch is None:
            return features_of(levels, rest, opening=self.opening)
        of_pads = []
        for column, pad in enumerate(rest.gripping):
            patches = pressed(levels.maps[column][:, -1], levels.noise[:, -1, column])
            grid = pad_grid(rest.pads, pad)
            of_pads.append([self.of_patch(patch, grid, outline) for patch in patches])
        return np.concatenate(of_pads, axis=1)


_NETWORK = MLPClassifier((32,), solver="lbfgs", random_state=0)
_PENALTIES, _OUTLINES = {"alpha": (0.1, 0.01, 1.0, 10.0)}, (0.3, 0.2, 0.5)
_DISCRIMINANT = LinearDiscriminantAnalysis(solver="lsqr"), {"shrinkage": ("auto", 0.03, 0.3)}
METHODS = {
    "discriminant": Comparator(None, *_DISCRIMINANT),
    "extra_trees": Comparator(
        None,
        ExtraTreesClassifier(300, random_state=0),
        {"max_features": ("sqrt", 0.3), "min_samples_leaf": (1, 2, 4)},
    ),
    "raw_neighbours": Comparator(
        centred, KNeighborsClassifier(), {"n_neighbors": (1, 3, 5)}, scaled=False
    ),
    "contact_invariants": Comparator(sections, *_DISCRIMINANT),
    "radius_vector": Comparator(radius_vector, _NETWORK, _PENALTIES, outlines=_OUTLINES),
    "contour_network": Comparator(contour, _NETWORK, _PENALTIES, outlines=_OUTLINES),
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
        best |= {"outline": method.outline_} if len(method.outlines) > 1 else {}
        chosen = "; " + ", ".join(f"{key} {value}" for key, value in best.items())
    else:
        recognizer = make_trainer(name, use_aperture=opening).fit(train)
        names = [recognizer.posterior(grasp).best for grasp in test]
    right = sum(one == label for one, label in zip(names, truth, strict=True))
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
