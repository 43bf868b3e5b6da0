"""What goes into and comes out of one look at a grasp."""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Rows:
    """Features of grasps under each drift that they may have had.

    Attributes
    ----------
    tactile : (n, G, Ft) float64
        Features of touch, each of the gains undone.
    aperture : (n, O, Fa) float64
        Features of the opening, each of the offsets undone; Fa is 0 where it is not used.
    """

    tactile: NDArray[np.float64]
    aperture: NDArray[np.float64]

    @property
    def middle(self) -> NDArray[np.float64]:
        """Features (n, Ft + Fa) with the middle gain and offset undone."""
        gain, offset = self.tactile.shape[1] // 2, self.aperture.shape[1] // 2
        return np.concatenate([self.tactile[:, gain], self.aperture[:, offset]], axis=1)

    def take(self, rows: NDArray[np.bool_]) -> Self:
        """Return some of the grasps."""
        return type(self)(tactile=self.tactile[rows], aperture=self.aperture[rows])


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Telling:
    """What n grasps tell.

    Attributes
    ----------
    scores : (n, C) float64
        Logarithm of the likelihood of each class, up to a constant of the grasp.
    signs : (n, S) float64
        Logarithms of distances under the expected drift, for the sense of the strange: of what
        looks strange, a drift can explain too much.
    """

    scores: NDArray[np.float64]
    signs: NDArray[np.float64]
