"""Which filter of the frames before any surface is fitted: accuracy at 8 and 16 % of noise."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import convolve, median_filter, uniform_filter1d

from benchmarks._measure import line, repeats
from benchmarks._posed_grasps import Sensing, draw_placing, posed_grasp
from recognition.grasp import Grasp, PadArray
from recognition.metrics import wilson_interval
from recognition.recognizers import make_trainer
from simulator.shapes import PAPER_OBJECTS

_FINE = 16
"""Filtered counts keep sixteenths: rounding to whole counts would be a filter too."""
_BINOMIAL = np.outer([1.0, 2.0, 1.0], [1.0, 2.0, 1.0]) / 16.0

Frames = NDArray[np.float64]


def _spatial(work: Callable[[Frames], Frames]) -> Callable[[Frames, PadArray], Frames]:
    def each_pad(frames: Frames, pads: PadArray) -> Frames:
        out = frames.copy()
        for pad in range(pads.n_pads):
            taxels = pads.taxels_of(pad)
            grids = frames[:, taxels].reshape(-1, *pads.pad_shape[pad])
            out[:, taxels] = work(grids).reshape(len(frames), -1)
        return out

    return each_pad


_mean_3x3 = _spatial(lambda grids: convolve(grids, _BINOMIAL[None], mode="nearest"))
_median_3x3 = _spatial(lambda grids: median_filter(grids, (1, 3, 3), mode="nearest"))

FILTERS: dict[str, Callable[[Frames, PadArray], Frames]] = {
    "none before": lambda frames, _: frames,
    "mean of 5 frames": lambda frames, _: uniform_filter1d(frames, 5, axis=0, mode="nearest"),
    "median of 5 frames": lambda frames, _: median_filter(frames, (5, 1), mode="nearest"),
    "mean of 3 x 3 taxels": _mean_3x3,
    "median of 3 x 3 taxels": _median_3x3,
    "mean of 5, then of 3 x 3": lambda frames, pads: _mean_3x3(
        uniform_filter1d(frames, 5, axis=0, mode="nearest"), pads
    ),
}


def filtered(grasp: Grasp, work: Callable[[Frames, PadArray], Frames]) -> Grasp:
    """Return the grasp with filtered frames, in sixteenths of a count."""
    frames = work(grasp.counts.astype(np.float64), grasp.pads)
    pads = replace(grasp.pads, adc_max=_FINE * grasp.pads.adc_max)
    return replace(grasp, pads=pads, counts=np.rint(_FINE * frames).astype(np.uint16))


def main(effort: float = 1.0) -> None:
    n_train, n_test = repeats(20, effort, least=4), repeats(60, effort, least=2)
    labels = list(PAPER_OBJECTS)[: repeats(5, effort, least=2)]
    line("compared", f"{len(labels)} objects, {n_train} grasps teach, {n_test} test, touch alone")
    for noise in (1.0, 2.0):
        rng = np.random.default_rng(17)
        sensing = Sensing(noise=noise)
        train, test = (
            [
                posed_grasp(label, label, draw_placing(rng), first + i, sensing)
                for label in labels
                for i in range(n)
            ]
            for first, n in ((0, n_train), (10_000, n_test))
        )
        for trainer in ("force_ramp", "level_check"):
            right = {}
            for name, work in FILTERS.items():
                taught = make_trainer(trainer, use_aperture=False).fit(
                    [filtered(g, work) for g in train]
                )
                right[name] = sum(taught.posterior(filtered(g, work)).best == g.label for g in test)
                low, high = wilson_interval(right[name], len(test))
                line(
                    f"  {8 * noise:.0f} %, {trainer}",
                    f"{100 * right[name] / len(test):5.1f} % ({100 * low:.1f} to {100 * high:.1f}) "
                    f"{name}",
                )
            best = max(right, key=lambda name: right[name])
            line(
                "  ratio",
                f"best ({best}) to none: {max(right[best], 1) / max(right['none before'], 1):.3f}",
            )


if __name__ == "__main__":
    main()
