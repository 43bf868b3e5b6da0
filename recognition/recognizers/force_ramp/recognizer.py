"""Default recognizer `force_ramp`: patches, their growth along the ramp, and the opening.

It answers under each hypothesis of a grid of drifts, and sums over them.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from recognition.drift.drift import DriftGrid, DriftPrior
from recognition.drift.self_zero import at_zero, common_zero, foam_odds, prior_since
from recognition.features import FEATURE_VERSION, pad_grids, sizes_mm
from recognition.grasp import CELL_SOURCE, Grasp, SelfZero, by_label
from recognition.ramp.ramp import Rest, learn_rest, load_levels
from recognition.recognizer import DEPENDENCE, Posterior
from recognition.recognizers.force_ramp.view import View, describe, fit_view
from recognition.records import TaughtRecord
from recognition.statistics.calibration import UNIFORM_SHARE

MIN_GRASPS = 3
"""Fewest grasps of an object: two to see how they vary, one to check the estimate on."""
_SOON_MS = 3_600_000
"""Time in ms from a taught grasp within which the sensors hardly drift."""
_SOON_UNCHANGED = 0.99
"""Probability of no drift within that time, on the cell that taught. Else 0: with an assumed zero
names are certain, and wrong if the error equals the difference between two objects."""
_NEW_IN_ANSWER = 20.0
"""Factor on the likelihood of a new object in an answer. A wrong name costs more than UNKNOWN, so a
drift must fit well to explain a new object. Following has no factor."""
_SLACK = 2.0
"""Tolerance of a size in standard deviations of the opening's zero."""
_KNOWN_OFFSET_MM = 0.3
"""Largest standard deviation of the opening's zero with which a drawn thickness is compared, in mm.
"""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Evidence:
    """One grasp under each hypothesis of the drift."""

    classes: NDArray[np.int64]
    """(K,) int64: numbers of the likely objects, ascending."""
    log_likelihood: NDArray[np.float64]
    """(G, O, K) or (G, 1, K) float64: of each of these."""
    new: NDArray[np.float64]
    """(G, O) or (G, 1) float64: probability of a new object."""
    view: View
    """The view of this evidence."""

    def of_any(self) -> NDArray[np.float64]:
        """Return (G, O) or (G, 1): log likelihood of any object, taught or new."""
        taught = logsumexp(self.log_likelihood, axis=-1)
        return np.asarray(np.logaddexp(taught, self.view.log_new), dtype=np.float64)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ForceRampRecognizer(TaughtRecord):
    """A taught recognizer with two views: touch and opening, and touch alone."""

    version: ClassVar[int] = FEATURE_VERSION
    labels: tuple[str, ...]
    """The taught objects, sorted."""
    rest: Rest
    """The untouched pads."""
    touch: View
    """The view of touch alone, for grasps whose opening is unknown."""
    both: View | None
    """The view of touch and opening; None if the opening is not used or was never known."""
    taught_ms: NDArray[np.int64]
    """(C,) int64: time of the last taught grasp of each object."""
    taught_on: tuple[str, ...]
    """Sources of the taught grasps that name a cell; may be empty."""
    drawn_m: NDArray[np.float64]
    """(C, k) float64: thicknesses of each object along the closing axis by its drawing in m, filled
    up with NaN."""
    zero: SelfZero | None = None
    """Self-zero of the teaching; None without one."""
    grid: DriftGrid = field(default_factory=DriftGrid)
    """The drift since teaching, or since the self-zeros of both days were compared."""
    caution: float = 1.0
    """The odds of a new object are multiplied by it."""

    def __post_init__(self) -> None:
        if not len(self.labels) == len(self.drawn_m) == len(self.taught_ms):
            raise ValueError(f"the arrays of the model do not fit its {len(self.labels)} labels")

    def posterior(self, grasp: Grasp) -> Posterior:
        """Return the posterior of a grasp. Raises ValueError for pads other than the taught ones.

        A grasp that never touched both pads gives even probabilities and is unknown with 1.
        """
        evidence = self.evidence(grasp)
        if evidence is None:
            return Posterior.uninformed(self.labels)
        grid = self.grid_at(grasp)
        unchanged = self._unchanged(grasp)
        log_weight = grid.log_weight(unchanged[evidence.classes])
        joint = evidence.log_likelihood + np.moveaxis(log_weight, 0, -1)
        # A new object has the mean of the taught ones.
        new_weight = grid.log_weight(unchanged.mean())
        probability = np.zeros(len(self.labels))
        of_each = logsumexp(joint, axis=(0, 1))
        probability[evidence.classes] = np.exp(of_each - logsumexp(of_each))
        any_day = grid.offset_mm(np.exp(new_weight))[1] / DriftPrior().offset_sd_mm
        # An unknown zero is an error that all grasps of a part have in common.
        common = min(1.0, any_day**2)
        even = max(UNIFORM_SHARE, evidence.view.even_share * common)
        probability = (1.0 - even) * probability + even / len(self.labels)
        probability /= probability.sum()
        log_new = new_weight + evidence.view.log_new + np.log(_NEW_IN_ANSWER * self.caution)
        log_share = np.logaddexp(logsumexp(joint, axis=-1), log_new)
        share = np.exp(log_share - logsumexp(log_share))
        odds_of_taught = 1.0 / float(np.clip((share * evidence.new).sum(), 1e-12, 1.0)) - 1.0
        caution, moved_m = self.caution, 0.0
        if self.zero is not None and grasp.zero is not None:
            caution *= foam_odds(self.zero, grasp.zero)
            # The offset of the opening since teaching, by both self-zeros.
            moved_m = grasp.zero.opening_m - self.zero.opening_m
        mean_mm, sd_mm = grid.offset_mm(share)
        drawn_m = self.drawn_m[int(probability.argmax())]
        drawn_m = drawn_m[np.isfinite(drawn_m) & (sd_mm <= _KNOWN_OFFSET_MM)]
        return Posterior(
            labels=self.labels,
            probability=probability,
            unknown=caution / (caution + odds_of_taught),
            dependence=max(DEPENDENCE, common),
            drawn_m=tuple((drawn_m + 1e-3 * mean_mm + moved_m).tolist()),
        )

    def evidence(self, grasp: Grasp, *, also: int = 0) -> Evidence | None:
        """Return a grasp under each hypothesis; None if it never touched both pads.

        Objects are the likely ones and the object with the number ``also``. Raises ValueError for
        pads other than the taught ones.
        """
        levels = load_levels([grasp], self.rest)
        if not levels.touched[0]:
            return None
        levels = at_zero(levels, [grasp], self.zero, self.rest.gripping)
        grid = self.grid_at(grasp)
        opening = self.both is not None and bool(np.all(np.isfinite(sizes_mm(levels))))
        view = self.both if self.both is not None and opening else self.touch
        features = describe(
            levels,
            pad_grids(self.rest),
            opening=opening,
            log_gains=grid.log_gains,
            offsets_mm=grid.offsets_mm,
            slack_mm=self._slack_mm(grasp),
        )
        classes, log_likelihood, new = view.likelihood(features, also=also)
        return Evidence(classes=classes, log_likelihood=log_likelihood[0], new=new[0], view=view)

    # Drift

    def gauge(self, label: str, grasps: Sequence[Grasp]) -> Self:
        """Return a copy after a few grasps of one taught object: a gauge.

        Several gauges with different objects add up.

        Raises ValueError if the object was not taught, or no grasp touched both pads.
        """
        if label not in self.labels:
            raise ValueError(
                f"{label!r} was not taught: gauge with one of {', '.join(self.labels)}"
            )
        number = self.labels.index(label)
        every = [self.evidence(grasp, also=number) for grasp in grasps]
        touched = [e for e in every if e is not None]
        if not touched:
            raise ValueError("no gauge grasp touched both pads: grasp the gauge object again")
        # The view with the opening, if a grasp has it.
        view = next((e.view for e in touched if e.view is self.both), touched[0].view)
        each = [e.log_likelihood[..., e.classes == number] for e in touched if e.view is view]
        total = np.sum(each, axis=0)[..., 0]
        at_ms, grid = grasps[-1].start_ms, self.grid_at(grasps[0])
        return self.with_grid(grid.with_gauge(total, view.placing_mm, at_ms))

    def without_gauges(self) -> Self:
        """Return a copy with the prior of the drift alone."""
        return self.with_grid(DriftGrid(prior=self.grid.prior, zero=self.grid.zero))

    def follow(self, grasp: Grasp) -> Self:
        """Return a copy after a grasp of an unnamed object, taught or not.

        A missed grasp changes nothing. Raises ValueError for pads other than the taught ones.
        """
        evidence = self.evidence(grasp)
        if evidence is None:
            return self
        return self.with_grid(self.grid_at(grasp).with_unnamed(evidence.of_any(), grasp.start_ms))

    def grid_at(self, grasp: Grasp) -> DriftGrid:
        """Return the drift at a grasp: a new self-zero gives a new prior, its end any drift."""
        zero = None if self.zero is None else grasp.zero
        if zero == self.grid.zero:
            return self.grid.at(grasp.start_ms)
        if self.zero is None or zero is None:
            return DriftGrid()
        return DriftGrid(prior=prior_since(self.zero, zero), zero=zero)

    def with_grid(self, grid: DriftGrid) -> Self:
        """Return a copy with another estimate of the drift."""
        return replace(self, grid=grid)

    def with_caution(self, caution: float) -> Self:
        """Return a copy that multiplies the odds of a new object by the caution."""
        return replace(self, caution=caution)

    @property
    def ends_early(self) -> bool:
        """Whether its answers to the first part of a ramp may end it: with the opening alone.

        By touch alone this is not shown, and little is gained (docs/explanations/sequences.md).
        """
        return self.both is not None

    def _unchanged(self, grasp: Grasp) -> NDArray[np.float64]:
        """Return (C,): prior probability of no drift since each object was taught."""
        grid = self.grid_at(grasp)
        if grid.zero is None and (grid.prior != DriftPrior() or grid.n_gauged):
            return np.full(len(self.labels), grid.prior.unchanged)
        return np.where(self._soon(grasp), _SOON_UNCHANGED, 0.0)

    def _soon(self, grasp: Grasp) -> NDArray[np.bool_]:
        """Return (C,): whether the zero of the opening is that at which an object was taught.

        That is so within one session: each hour until the grasp has the end of a teaching.
        """
        grid = self.grid_at(grasp)
        same_zero = grid.prior == DriftPrior() if grid.zero is None else grid.zero == self.zero
        elsewhere = self.taught_on and _on_cell(grasp) and grasp.source not in self.taught_on
        order = np.argsort(self.taught_ms)
        at_ms = self.taught_ms[order]
        session = np.cumsum(np.diff(at_ms, prepend=at_ms[0]) > _SOON_MS)
        now = session[np.abs(at_ms - grasp.start_ms) <= _SOON_MS]
        soon = np.isin(session, now)[np.argsort(order)]
        return soon & (same_zero and not elsewhere and not grid.n_gauged)

    def _slack_mm(self, grasp: Grasp) -> NDArray[np.float64]:
        """Return (O,): tolerance of the size of an object under each offset, in mm.

        Sizes count if the zero of the opening is known: within the session, or after a self-zero.
        """
        grid = self.grid_at(grasp)
        offsets_mm = grid.offsets_mm
        slack_mm = np.full(len(offsets_mm), _SLACK * grid.prior.offset_sd_mm)
        if self._soon(grasp).any():
            slack_mm[np.argmin(np.abs(offsets_mm))] = 0.0
        return slack_mm

    # Files

    def to_arrays(self, prefix: str = "") -> dict[str, NDArray[Any]]:
        """Return everything that was taught as plain arrays, without the unnamed grasps."""
        return TaughtRecord.to_arrays(self.with_caution(1.0), prefix)


@dataclass(frozen=True, slots=True, kw_only=True)
class ForceRampTrainer:
    """Teaches the default recognizer."""

    name: ClassVar[str] = "force_ramp"
    min_grasps: ClassVar[int] = MIN_GRASPS
    """Least number of grasps of an object."""
    use_aperture: bool = True

    @property
    def uses_aperture(self) -> bool:
        """Whether the opening between the fingers is used."""
        return self.use_aperture

    def fit(self, grasps: Sequence[Grasp]) -> ForceRampRecognizer:
        """Teach the recognizer with labelled grasps.

        Grasps that never touched both pads are left out. A single object is taught against all
        others. Raises ValueError if an object has fewer than ``MIN_GRASPS`` grasps left.
        """
        members = by_label(grasps)
        ordered = [g for group in members.values() for g in group]
        rest = learn_rest(ordered)
        zero = common_zero(ordered)
        levels = at_zero(load_levels(ordered, rest), ordered, zero, rest.gripping)
        touched = levels.touched
        names = np.array([g.label for g in ordered])
        labels, classes, n_of = np.unique(names[touched], return_inverse=True, return_counts=True)
        pressed = dict.fromkeys(members, 0) | dict(zip(labels.tolist(), n_of.tolist(), strict=True))
        few = [f"{label} {n}" for label, n in pressed.items() if n < MIN_GRASPS]
        if few or not pressed:
            raise ValueError(
                f"grasps that touched both pads: {', '.join(few)}; each object needs at least "
                f"{MIN_GRASPS} to show its variation: teach more, and press harder"
            )
        levels, grids = levels.take(touched), pad_grids(rest)
        known = np.all(np.isfinite(sizes_mm(levels)), axis=1)
        both = None
        if self.use_aperture and np.all(
            np.bincount(classes[known], minlength=len(labels)) >= MIN_GRASPS
        ):
            both = fit_view(levels.take(known), grids, classes[known], opening=True)
        return ForceRampRecognizer(
            labels=tuple(labels.tolist()),
            rest=rest,
            touch=fit_view(levels, grids, classes, opening=False),
            both=both,
            taught_ms=np.array([group[-1].start_ms for group in members.values()]),
            taught_on=tuple(sorted({g.source for g in ordered if _on_cell(g)})),
            drawn_m=_drawn_m(list(members.values())),
            zero=zero,
        )


def _drawn_m(members: Sequence[Sequence[Grasp]]) -> NDArray[np.float64]:
    """Return the different thicknesses of each object by its drawing, (C, k), to 0.1 mm."""
    drawn_m = [np.unique(np.round([g.thickness_m for g in group], 4)) for group in members]
    longest = max(len(sizes_m) for sizes_m in drawn_m)
    return np.stack([np.pad(m, (0, longest - len(m)), constant_values=np.nan) for m in drawn_m])


def _on_cell(grasp: Grasp) -> bool:
    """Return whether the source of a grasp names its cell."""
    return grasp.source.startswith(CELL_SOURCE)
