"""A made-up grasp for a model that was just read: what does not fit fails now."""

import numpy as np

from recognition.errors import RecognitionError
from recognition.grasp import Grasp, PadArray
from recognition.recognizer import Recognizer

_REHEARSED_FRAMES = 40
_REHEARSED_FORCE_N = 8.0


def rehearse(recognizer: Recognizer, pads: PadArray) -> None:
    """Ask about a made-up grasp, so that arrays that do not fit fail now and not over a held part.

    A recogniser that refuses the grasp for what it is raises a RecognitionError; that is no fault.
    """
    share = np.linspace(0.0, 1.0, _REHEARSED_FRAMES)
    offset_m = pads.taxel_xy_m - pads.taxel_xy_m.mean(axis=0)
    extent_m = max(float(np.abs(offset_m).max()), 1e-6)
    print_ = np.maximum(0.0, 1.0 - np.sum((offset_m / (0.6 * extent_m)) ** 2, axis=1))
    grasp = Grasp(
        pads=pads,
        counts=(0.6 * pads.adc_max * share[:, None] * print_).astype(np.uint16),
        t_s=np.linspace(0.0, 2.0, _REHEARSED_FRAMES),
        aperture_m=np.linspace(0.03, 0.02, _REHEARSED_FRAMES),
        force_n=_REHEARSED_FORCE_N * share,
        label="",
    )
    try:
        posterior = recognizer.posterior(grasp)
    except RecognitionError:
        return
    if not np.all(np.isfinite(posterior.probability)) or not np.isfinite(posterior.unknown):
        raise ValueError("its probabilities are not finite")
