"""What pads cost that answer otherwise than in teaching: dead taxels, other gains, a row further.

Of the first 60 per cent of each object's grasps the first 60 or 40 or the last 60 per cent teach,
and the others of them are tested: as they are, with three taxels of each pad dead, with the gain of
each taxel changed by 10 per cent (standard deviation of its logarithm), and with what the pads felt
moved by one row of taxels along the finger. Nothing tells the recogniser. One draw of taxels and
gains. The ratio compares wrong answers by touch alone.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from benchmarks._grasps import recorded, simulated
from benchmarks._measure import line, repeats
from recognition.grasp import Grasp
from recognition.metrics import wilson_interval
from recognition.recognizers.force_ramp import ForceRampTrainer
from recognition.splits import chronological_split

_DEAD_PER_PAD = 3
_LOG_GAIN_SD = 0.1


def changes(grasp: Grasp, seed: int = 0) -> Mapping[str, Callable[[Grasp], Grasp]]:
    """Return what may have changed, by name, for grasps by the same pads as the given one."""
    pads, rng = grasp.pads, np.random.default_rng(seed)
    numbers = [np.flatnonzero(pads.taxel_pad == pad) for pad in range(len(pads.pad_shape))]
    dead = np.concatenate([rng.choice(mine, _DEAD_PER_PAD, replace=False) for mine in numbers])
    gains = np.exp(_LOG_GAIN_SD * rng.standard_normal(len(pads.taxel_pad)))

    def without(grasp: Grasp) -> Grasp:
        counts = grasp.counts.copy()
        counts[:, dead] = 0
        return replace(grasp, counts=counts)

    def regained(grasp: Grasp) -> Grasp:
        counts = np.clip(np.rint(grasp.counts * gains), 0, pads.adc_max)
        return replace(grasp, counts=counts.astype(np.uint16))

    def moved(grasp: Grasp) -> Grasp:
        counts = np.zeros_like(grasp.counts)
        for mine, (_, columns) in zip(numbers, pads.pad_shape, strict=True):
            counts[:, mine[columns:]] = grasp.counts[:, mine[:-columns]]
        return replace(grasp, counts=counts)

    return {
        "as taught": lambda grasp: grasp,
        "dead taxels": without,
        "other gains": regained,
        "a row further": moved,
    }


def _share(right: Sequence[bool]) -> str:
    low, high = wilson_interval(sum(right), len(right))
    return f"{100 * sum(right) / len(right):.1f} % ({100 * low:.1f}-{100 * high:.1f})"


def main(effort: float = 1.0) -> None:
    grasps = recorded()
    if grasps is None:
        grasps = simulated(2, repeats(20, effort, least=14))
    first, _ = chronological_split(grasps, 0.6)
    early, late = chronological_split(first, 0.4)
    splits = [chronological_split(first, 0.6), (early, late), (late, early)]
    splits = splits[: repeats(len(splits), effort)]
    ways = changes(first[0])
    right: dict[tuple[bool, str], list[bool]] = {}
    unknown: dict[tuple[bool, str], list[bool]] = {}
    for train, test in splits:
        for opening in (False, True):
            taught = ForceRampTrainer(use_aperture=opening).fit(train)
            for name, change in ways.items():
                told = [taught.posterior(change(grasp)) for grasp in test]
                named = [p.best == g.label for p, g in zip(told, test, strict=True)]
                right.setdefault((opening, name), []).extend(named)
                unknown.setdefault((opening, name), []).extend(p.unknown > 0.5 for p in told)
    n = len(right[False, "as taught"])
    line("compared", f"{len({g.label for g in first})} objects, {n} grasps tested")
    for opening in (False, True):
        line("  touch and opening" if opening else "  touch", "")
        for name in ways:
            rejected = 100 * float(np.mean(unknown[opening, name]))
            line(f"    {name}", f"{_share(right[opening, name])}, {rejected:.1f} % called UNKNOWN")
    wrong = [max(n - sum(right[False, name]), 0.5) for name in ("dead taxels", "as taught")]
    line("  ratio", f"touch errs {wrong[0] / wrong[1]:.2f} times as often with dead taxels")


if __name__ == "__main__":
    main()
