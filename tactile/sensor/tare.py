"""The tare: the zero of each taxel from untouched frames, or a refusal. Pure.

A hand on the sensor during the tare makes every later force wrong. So the zero is refused at any
sign of a touch.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from tactile.errors import TareRefused
from tactile.sensor.filters import Mask, Neighbourhood, Values, fill_bad
from tactile.sensor.settings import SensorSettings

LEAST_FRAMES = 8
"""Fewest frames: in fewer a healthy taxel may be constant by chance."""
_NOISY_SHARE = 0.5
"""Largest share of constant taxels of a sensor that shows noise: one pad of two may be dead."""
_LIVELY_COUNTS = 0.7
"""Least median standard deviation of the other taxels in counts. With less, a healthy taxel is
often constant for `SensorSettings.stuck_frames`."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TaxelHealth:
    """Health of each taxel, judged from untouched frames."""

    kinds: Mapping[str, Mask]
    """Taxels that do not measure by kind, (n_taxels,) bool each: ``dead``, constantly 0 while
    others show noise; ``stuck``, constant at another value meanwhile; ``at full scale``,
    constantly, independent of the others."""
    noisy: bool
    """bool: whether the sensor shows noise; else only a change of the force shows a frozen one."""
    lively: bool
    """bool: whether noise changes each healthy taxel; else dead and stuck ones cannot be found."""

    @property
    def bad(self) -> Mask:
        """Taxels that do not measure, (n_taxels,) bool."""
        bad: Mask = np.logical_or.reduce(list(self.kinds.values()))
        return bad

    def summary(self) -> str:
        """Return the numbers of bad taxels in words."""
        return ", ".join(f"{np.count_nonzero(mask)} {kind}" for kind, mask in self.kinds.items())


def assess_health(frames: NDArray[np.uint16], adc_max: int) -> TaxelHealth:
    """Judge the taxels from untouched frames.

    Raises TareRefused for fewer than 8 frames.

    Parameters
    ----------
    frames : (n_frames, n_taxels) uint16
        Raw counts of consecutive frames, at least 8.
    """
    if len(frames) < LEAST_FRAMES:
        raise TareRefused(f"a tare of {len(frames)} frames, at least {LEAST_FRAMES} are needed")
    low, high = frames.min(axis=0), frames.max(axis=0)
    constant = low == high
    noisy = bool(np.count_nonzero(constant) <= _NOISY_SHARE * len(constant))
    lively = noisy and float(np.median(frames.std(axis=0)[~constant])) >= _LIVELY_COUNTS
    full = low >= adc_max
    flat = constant & ~full if lively else np.zeros_like(constant)
    kinds = {"dead": flat & (low == 0), "stuck": flat & (low > 0), "at full scale": full}
    return TaxelHealth(kinds=kinds, noisy=noisy, lively=lively)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TareResult:
    """The zero."""

    offset_counts: Values = field(repr=False)
    """(n_taxels,) float64: mean counts without a touch; bad taxels have their neighbours' mean."""
    noise_counts: Values = field(repr=False)
    """(n_taxels,) float64: standard deviation of the counts."""
    health: TaxelHealth = field(repr=False)
    """Health of each taxel."""
    n_frames: int
    """Frames averaged."""
    t_s: float
    """Monotonic time of the last one in s."""


def too_many_bad(n_bad: int, n_taxels: int, share: float) -> bool:
    """Return whether a pad has more bad taxels than a share allows; a small pad may have one."""
    return n_bad > (max(1.0, share * n_taxels) if share > 0.0 else 0.0)


def compute_tare(
    hood: Neighbourhood, frames: NDArray[np.uint16], limits: SensorSettings, t_s: float
) -> TareResult:
    """Compute the zero from frames, shape (n_frames, n_taxels); raises TareRefused."""
    layout = hood.layout
    health = assess_health(frames, layout.adc_max)
    for index, pad in enumerate(layout.pads):
        n_bad = int(np.count_nonzero(health.bad[layout.taxels_of(index)]))
        if too_many_bad(n_bad, pad.n_taxels, limits.bad_share):
            raise TareRefused(
                f"{n_bad / pad.n_taxels:.0%} of the taxels of pad {pad.name} are bad "
                f"({health.summary()} on all pads), allowed are {limits.bad_share:.0%}: "
                "check its cable, or replace it"
            )
    offset = fill_bad(hood, frames.mean(axis=0, dtype=np.float64), health.bad)
    smooth, pads = hood.mean(offset), layout.medians(offset)
    grip = list(layout.gripping_pads)
    others, pressed = np.delete(pads, grip), np.zeros(layout.n_pads)
    if len(others):
        pressed[grip] = pads[grip] - np.median(others)
    half = len(frames) // 2
    change = frames[half:].mean(axis=0) - frames[:half].mean(axis=0)
    for counts, share, text in (
        (
            offset,
            limits.rest_share,
            "pad {place} reads {counts:.1f} counts, allowed are {limit:.1f} for an untouched "
            "taxel: clear the pads and try again",
        ),
        (
            smooth - layout.medians(smooth)[layout.taxel_pad],
            limits.bump_share,
            "pad {place} reads {counts:.1f} counts more than the rest of its pad, allowed are "
            "{limit:.1f}: something touches the pad, so clear it and try again; or this part of it "
            "is worn, so replace the pad",
        ),
        (
            np.abs(hood.mean(fill_bad(hood, change, health.bad))),
            limits.moved_share,
            "the counts of pad {place} moved by {counts:.1f} while the zero was taken, allowed are "
            "{limit:.1f}: keep the fingers still and untouched, let the sensor warm up, and try "
            "again",
        ),
        (
            pressed[layout.taxel_pad],
            limits.pad_share,
            "pad {pad} reads {counts:.1f} counts more than the pads that nothing grips, allowed "
            "are {limit:.1f}: something presses on all of it; clear it and try again",
        ),
    ):
        worst, limit = int(np.argmax(counts)), share * layout.adc_max
        if counts[worst] > limit:
            pad = layout.pads[layout.taxel_pad[worst]].name
            place = layout.place(worst)
            raise TareRefused(text.format(pad=pad, place=place, counts=counts[worst], limit=limit))
    noise = frames.std(axis=0, dtype=np.float64)
    for array in (offset, noise):
        array.setflags(write=False)
    return TareResult(
        offset_counts=offset, noise_counts=noise, health=health, n_frames=len(frames), t_s=t_s
    )
