"""A decision already during the ramp: recognisers taught with ramps that were cut short."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d

from recognition.fusion import DecisionKind, StopRule, decide
from recognition.grasp import Grasp
from recognition.ramp import Rest, learn_rest
from recognition.recognizer import Posterior, Recognizer, Trainer

SHARES = (0.25, 0.5, 0.75)
"""Parts of the usual full load at which a ramp is looked at before its end."""
_QUIET_FRAMES = 3
_SMOOTHING_FRAMES = 5


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EarlyAnswer:
    """What a ramp told, and when.

    Attributes
    ----------
    posterior
        What the last look told.
    looks
        Number of looks, the last one included.
    n_frames
        Frames of the grasp that had been seen.
    decided
        Whether the stop rule was satisfied; False where the ramp came to its end without.
    """

    posterior: Posterior
    looks: int
    n_frames: int
    decided: bool


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EarlyRecognizer:
    """One recogniser for each load at which a ramp is looked at, and one for whole ramps.

    Attributes
    ----------
    rest
        The untouched pads.
    load_counts : (L,) float64
        Loads in counts, summed over the gripping pads, ascending.
    heads
        L recognisers, each taught with ramps cut at its load.
    whole
        The recogniser of whole ramps.
    """

    rest: Rest
    load_counts: NDArray[np.float64]
    heads: tuple[Recognizer, ...]
    whole: Recognizer

    @property
    def labels(self) -> tuple[str, ...]:
        """The taught objects."""
        return self.whole.labels

    def looks(self, grasp: Grasp) -> tuple[int, ...]:
        """Return after how many frames each load is reached; fewer than L where it never is.

        Only frames up to then count: a grasp that still goes on gives the same.
        """
        load = load_so_far(grasp, self.rest)
        reached = [np.flatnonzero(load >= level) for level in self.load_counts]
        return tuple(int(frames[0]) + 1 for frames in reached if len(frames))

    def posterior_at(self, grasp: Grasp, look: int) -> Posterior:
        """Answer a grasp cut at a look, from 0; the number after the last is the whole grasp.

        Raises IndexError where the grasp never reached that load.
        """
        if look == len(self.heads):
            return self.whole.posterior(grasp)
        return self.heads[look].posterior(cut(grasp, self.looks(grasp)[look]))

    def answer(self, grasp: Grasp, rule: StopRule) -> EarlyAnswer:
        """Look at each load in turn until the rule is satisfied, at last at the whole grasp."""
        one = StopRule(
            error_rate=rule.error_rate,
            max_grasps=2,
            max_unknown=rule.max_unknown,
            min_unknown=1.0,
            min_probability=rule.min_probability,
        )
        frames = self.looks(grasp)
        for look, n_frames in enumerate(frames):
            posterior = self.heads[look].posterior(cut(grasp, n_frames))
            if decide([posterior], one).kind is DecisionKind.DECIDED:
                return EarlyAnswer(
                    posterior=posterior, looks=look + 1, n_frames=n_frames, decided=True
                )
        posterior = self.whole.posterior(grasp)
        return EarlyAnswer(
            posterior=posterior,
            looks=len(frames) + 1,
            n_frames=grasp.n_frames,
            decided=decide([posterior], one).kind is DecisionKind.DECIDED,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class EarlyTrainer:
    """Teaches whole ramps and ramps cut short.

    Attributes
    ----------
    base
        What teaches each of the recognisers.
    shares
        Parts of the usual full load, ascending, between 0 and 1.
    """

    base: Trainer
    shares: tuple[float, ...] = SHARES

    def __post_init__(self) -> None:
        if not self.shares or list(self.shares) != sorted(set(self.shares)):
            raise ValueError(f"shares {self.shares} must be different and ascending")
        if not 0.0 < self.shares[0] <= self.shares[-1] < 1.0:
            raise ValueError(f"shares {self.shares} must lie between 0 and 1")

    def fit(self, grasps: Sequence[Grasp]) -> EarlyRecognizer:
        """Learn from labelled grasps; ramps that end below a load are taught whole.

        Each recogniser calibrates its probabilities on ramps cut like those that it will meet. A
        load at which the cut ramps do not suffice to teach, because in the noise too few of them
        show a touch, is not looked at. Raises ValueError where whole ramps do not suffice.
        """
        whole = self.base.fit(grasps)
        rest = learn_rest(grasps)
        loads = [load_so_far(g, rest) for g in grasps]
        full = float(np.median([load[-1] for load in loads]))
        levels = full * np.array(self.shares)
        heads: list[Recognizer] = []
        taught: list[float] = []
        for level in levels.tolist():
            ends = [np.flatnonzero(load >= level) for load in loads]
            parts = [
                cut(g, int(end[0]) + 1) if len(end) else g
                for g, end in zip(grasps, ends, strict=True)
            ]
            try:
                head = self.base.fit(parts)
            except ValueError:
                continue
            if head.labels == whole.labels:
                heads.append(head)
                taught.append(level)
        return EarlyRecognizer(
            rest=rest, load_counts=np.array(taught), heads=tuple(heads), whole=whole
        )


def load_so_far(grasp: Grasp, rest: Rest) -> NDArray[np.float64]:
    """Return the load in counts at each frame, (n_frames,), from that frame and earlier ones.

    The load is what the gripping pads read above the first frames of the grasp, over a running
    mean. Raises ValueError for pads other than the taught ones.
    """
    rest.check(grasp.pads)
    taxels = np.concatenate([grasp.pads.taxels_of(pad) for pad in rest.gripping])
    total = grasp.counts[:, taxels].sum(axis=1, dtype=np.float64)
    behind = (_SMOOTHING_FRAMES - 1) // 2
    smooth = uniform_filter1d(total, _SMOOTHING_FRAMES, mode="nearest", origin=behind)
    load: NDArray[np.float64] = smooth - total[:_QUIET_FRAMES].mean()
    return load


def cut(grasp: Grasp, n_frames: int) -> Grasp:
    """Return the first frames of a grasp."""
    return Grasp(
        pads=grasp.pads,
        counts=grasp.counts[:n_frames],
        t_s=grasp.t_s[:n_frames],
        aperture_m=grasp.aperture_m[:n_frames],
        force_n=grasp.force_n[:n_frames],
        label=grasp.label,
        shape=grasp.shape,
        source=grasp.source,
        start_ms=grasp.start_ms,
    )
