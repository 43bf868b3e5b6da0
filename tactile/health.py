"""Which taxels are broken: dead, stuck or saturated, judged from untouched frames. Pure."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Mask = NDArray[np.bool_]

LEAST_FRAMES = 8
"""Fewer frames cannot tell a healthy taxel that happens to repeat itself from a constant one."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TaxelHealth:
    """State of each taxel.

    Attributes
    ----------
    dead : (n_taxels,) bool
        Constantly 0 while the others show noise.
    stuck : (n_taxels,) bool
        Constant at another value while the others show noise.
    saturated : (n_taxels,) bool
        Constantly at full scale, whatever the others do.
    noisy : bool
        Whether the sensor shows noise; without, dead and stuck taxels cannot be told.
    """

    dead: Mask
    stuck: Mask
    saturated: Mask
    noisy: bool

    @property
    def bad(self) -> Mask:
        """Taxels that do not measure, (n_taxels,) bool."""
        bad: Mask = self.dead | self.stuck | self.saturated
        return bad

    def summary(self) -> str:
        """Return the numbers of bad taxels in words."""
        return (
            f"{np.count_nonzero(self.dead)} dead, {np.count_nonzero(self.stuck)} stuck, "
            f"{np.count_nonzero(self.saturated)} saturated"
        )


def assess_health(frames: NDArray[np.uint16], adc_max: int) -> TaxelHealth:
    """Judge the taxels from untouched frames.

    Parameters
    ----------
    frames : (n_frames, n_taxels) uint16
        Raw counts of consecutive frames, at least 8.
    adc_max
        Full scale.

    Raises
    ------
    ValueError
        For fewer than 8 frames.
    """
    if len(frames) < LEAST_FRAMES:
        raise ValueError(f"{len(frames)} frames, at least {LEAST_FRAMES} are needed")
    low, high = frames.min(axis=0), frames.max(axis=0)
    constant = low == high
    noisy = bool(np.count_nonzero(constant) < 0.5 * len(constant))
    saturated = low >= adc_max
    flat = constant & ~saturated if noisy else np.zeros_like(constant)
    dead, stuck = flat & (low == 0), flat & (low > 0)
    for mask in (dead, stuck, saturated):
        mask.setflags(write=False)
    return TaxelHealth(dead=dead, stuck=stuck, saturated=saturated, noisy=noisy)
