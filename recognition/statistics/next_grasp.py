"""Next grasp: the pose and force after which the answer is expected to be least wrong."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import log_softmax

from recognition.grasp import COMMAND_COLUMNS, Grasp, keep_array
from recognition.recognizer import Posterior, Trainer
from recognition.statistics.calibration import blocked_folds
from recognition.statistics.fusion import evidence, independent_share

_FOLDS = 4
"""Blocks of the taught grasps; each is answered by a recogniser that was taught without it."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PoseMemory:
    """Evidence of each taught grasp, by a recogniser taught without it, with its command.

    Raises ValueError where shapes or values do not fit.
    """

    labels: tuple[str, ...]
    """The taught objects."""
    commands: NDArray[np.float64]
    """(n, 5) float64: commanded pose and force: `recognition.grasp.COMMAND_COLUMNS`."""
    log_evidence: NDArray[np.float64]
    """(n, C) float64: logarithm of the probability of each label over the even one."""
    classes: NDArray[np.int64]
    """(n,) int64: index of the label of the object that was held."""

    def __post_init__(self) -> None:
        n, n_labels = len(self.classes), len(self.labels)
        if n < 1 or n_labels < 1:
            raise ValueError("a memory needs at least one grasp and one label")
        for name, shape in (
            ("commands", (n, len(COMMAND_COLUMNS))),
            ("log_evidence", (n, n_labels)),
            ("classes", (n,)),
        ):
            array = keep_array(self, name, getattr(self, name))
            if array.shape != shape:
                raise ValueError(f"{name} of a memory have shape {array.shape}, expected {shape}")
            if not np.all(np.isfinite(array)):
                raise ValueError(f"{name} of a memory are not finite")
        if self.classes.min() < 0 or self.classes.max() >= n_labels:
            raise ValueError(f"classes of a memory are not from 0 to {n_labels - 1}")

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """Return everything as plain arrays."""
        return {
            "labels": np.array(self.labels, dtype=np.str_),
            "placings": self.commands,
            "told": self.log_evidence,
            "classes": self.classes,
        }

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> Self:
        """Rebuild from `to_arrays`. Raises KeyError or ValueError where that cannot be."""
        return cls(
            labels=tuple(map(str, arrays["labels"].tolist())),
            commands=np.asarray(arrays["placings"], dtype=np.float64),
            log_evidence=np.asarray(arrays["told"], dtype=np.float64),
            classes=np.asarray(arrays["classes"], dtype=np.int64),
        )


def build_pose_memory(trainer: Trainer, grasps: Sequence[Grasp]) -> PoseMemory:
    """Return the memory of labelled grasps; each is answered by a recogniser taught without it.

    Grasps without a command help to teach these recognisers; they are not in the memory. Raises
    ValueError where no grasp has a command, or there are too few grasps of a label.

    Parameters
    ----------
    trainer
        Trainer of these recognisers; four are taught, each on three quarters of the grasps.
    grasps
        The labelled grasps, those of a label in the order of time.
    """
    labels, classes = np.unique([g.label for g in grasps], return_inverse=True)
    if not any(grasp.command for grasp in grasps):
        raise ValueError("none of the grasps has a commanded pose and force")
    probability = np.full((len(grasps), len(labels)), np.nan)
    for held_out in blocked_folds(classes, _FOLDS):
        recognizer = trainer.fit([g for g, out in zip(grasps, held_out, strict=True) if not out])
        if recognizer.labels != tuple(labels.tolist()):
            raise ValueError(f"of {labels.tolist()} only {list(recognizer.labels)} could be taught")
        for row in np.flatnonzero(held_out).tolist():
            if grasps[row].command:
                probability[row] = recognizer.posterior(grasps[row]).probability
    asked = np.flatnonzero(np.all(np.isfinite(probability), axis=1))
    commands = [command.values for row in asked.tolist() if (command := grasps[row].command)]
    return PoseMemory(
        labels=tuple(labels.tolist()),
        commands=np.array(commands, dtype=np.float64).reshape(-1, len(COMMAND_COLUMNS)),
        log_evidence=evidence(probability[asked]),
        classes=classes[asked],
    )


_SHARED = {"force": 0.2, "offset": 0.01, "rotation": 0.01, "roll": 0.01}
"""Prior share of the spread of the losses within a label that each part of the setting explains in
the same way for all labels: a hard grasp shows more of any object."""
_OWN = {"force": 0.01, "offset": 0.01, "rotation": 0.04, "roll": 0.01}
"""The same for what the setting explains of one label beside that."""
_NOISE = 0.8
"""Share of the spread of the losses that pose and force do not explain."""
_N_CURVES = {"force": 2, "offset": 4, "rotation": 4, "roll": 4}
"""Curves of each part of the setting, in the order of `_curves`."""
_BEST_SHARE = 8
"""After the first grasp, a candidate among the best eighth is good enough."""
_STILL = 1e-9
"""Spread, in m, rad or N, up to which a quantity counts as constant while teaching."""


def expected_loss(
    memory: PoseMemory, posteriors: Sequence[Posterior], candidates: ArrayLike
) -> NDArray[np.float64]:
    """Return the expected loss of the fused answer after each candidate, up to a constant.

    The taught grasps of each label stand for a further grasp if that label is held; each is fused
    with the grasps so far, and minus the logarithm of the probability that the label then has is
    its loss. A regression of these losses on pose and force, each label weighted by its probability
    now, shows where they are small. The loss goes by the true label, not by how sure the answer
    is: a pose in which the recogniser errs with confidence is avoided.

    A few taught grasps of each label show little of it alone, so the labels are regressed together:
    slopes that all share, and deviations of each label that are drawn towards none the more, the
    less its grasps show of them. Raises ValueError if candidates or posteriors do not fit the
    memory.

    Parameters
    ----------
    memory
        Evidence of the taught grasps.
    posteriors
        The grasps so far, possibly none.
    candidates : (m, 5)
        Commands of possible next grasps: `recognition.grasp.COMMAND_COLUMNS`.

    Returns
    -------
    (m,) float64
        Smaller is better.
    """
    rows = np.asarray(candidates, dtype=np.float64)
    n_labels = len(memory.labels)
    if rows.ndim != 2 or rows.shape[1] != len(COMMAND_COLUMNS):
        raise ValueError(
            f"candidates have shape {rows.shape}, expected (m, {len(COMMAND_COLUMNS)})"
        )
    if any(p.labels != memory.labels for p in posteriors):
        raise ValueError(f"posteriors are not of the {n_labels} remembered labels")
    so_far = np.zeros(n_labels)
    dependence = 0.0
    if posteriors:
        so_far = evidence(np.stack([p.probability for p in posteriors])).sum(axis=0)
        dependence = float(np.mean([p.dependence for p in posteriors]))
    now = np.exp(log_softmax(independent_share(max(len(posteriors), 1), dependence) * so_far))
    share = independent_share(len(posteriors) + 1, dependence)
    after = log_softmax(share * (so_far + memory.log_evidence), axis=1)
    loss = -after[np.arange(len(memory.classes)), memory.classes]
    found: NDArray[np.float64] = _basis(memory, rows) @ _slopes(memory, loss, now)
    return found


def best_next_grasp(
    memory: PoseMemory, posteriors: Sequence[Posterior], candidates: ArrayLike
) -> int:
    """Return the index of the candidate to take.

    The first grasp is the one with the least expected loss. Later ones are the first candidate
    among the best eighth: the least loss alone asks for much the same grasp again and again, and
    like grasps repeat their errors.
    """
    loss = expected_loss(memory, posteriors, candidates)
    n_best = max(1, len(loss) // _BEST_SHARE) if posteriors else 1
    return int(np.argsort(loss, kind="stable")[:n_best].min())


def _basis(memory: PoseMemory, commands: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the curves (n, k) along which losses may change; each varies by 1 over the memory.

    Pads and most objects look alike after half a turn, so turns count twice and four times.
    """
    curves, taught = _curves(memory, commands), _curves(memory, memory.commands)
    spread = taught.std(axis=0)
    basis: NDArray[np.float64] = curves - taught.mean(axis=0)
    return basis / np.where(spread > _STILL, spread, np.inf)


def _curves(memory: PoseMemory, commands: NDArray[np.float64]) -> NDArray[np.float64]:
    mean, spread = memory.commands.mean(axis=0), memory.commands.std(axis=0)
    z = (commands - mean) / np.where(spread > _STILL, spread, np.inf)
    x, y, force = z[:, 0], z[:, 1], z[:, 4]
    turned = [
        f(times * commands[:, column])
        for column in (2, 3)
        for times in (2.0, 4.0)
        for f in (np.cos, np.sin)
    ]
    return np.stack([force, force**2, x, y, x**2, y**2, *turned], axis=1)


def _shares(of: Mapping[str, float]) -> NDArray[np.float64]:
    """Return the share of each curve."""
    return np.concatenate([np.full(n, of[part] / n) for part, n in _N_CURVES.items()])


def _slopes(
    memory: PoseMemory, loss: NDArray[np.float64], now: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the slopes (k,) of the expected loss along the curves.

    Least squares with normal priors, for the shared slopes and all deviations at once. Given the
    shared slopes the labels are independent of each other, so their deviations are eliminated label
    by label.
    """
    n_labels = len(memory.labels)
    basis = _basis(memory, memory.commands)
    k = basis.shape[1]
    square, product = np.zeros((n_labels, k, k)), np.zeros((n_labels, k))
    for label in np.unique(memory.classes).tolist():
        rows = memory.classes == label
        centred = basis[rows] - basis[rows].mean(axis=0)
        square[label] = centred.T @ centred / _NOISE
        product[label] = centred.T @ (loss[rows] - loss[rows].mean()) / _NOISE
    own = np.linalg.inv(square + np.diag(1.0 / _shares(_OWN)))
    kept = np.eye(k) - square @ own
    shared = np.linalg.solve(
        np.diag(1.0 / _shares(_SHARED)) + (kept @ square).sum(axis=0),
        np.einsum("cij,cj->i", kept, product),
    )
    deviations = np.einsum("cij,cj->ci", own, product - square @ shared)
    slopes: NDArray[np.float64] = shared + now @ deviations
    return slopes
