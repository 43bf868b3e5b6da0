"""Where on its pad each finger presses: the mean position of the taxels, weighted by force."""

import numpy as np
from numpy.typing import NDArray

from tactile.layout import TaxelLayout

Centres = tuple[tuple[float, float], tuple[float, float]]


class ForceCentres:
    """Centre of force on both gripping pads.

    Parameters
    ----------
    layout
        The taxels.
    """

    def __init__(self, layout: TaxelLayout) -> None:
        self._taxels = tuple(np.flatnonzero(layout.taxel_pad == p) for p in layout.gripping_pads)
        self._xy_m = tuple(layout.taxel_xy_m[taxels] for taxels in self._taxels)

    def of(self, force_n: NDArray[np.float64]) -> Centres | None:
        """Return the centres in m, along the fingers and across; None where a pad has no force.

        Parameters
        ----------
        force_n : (n_taxels,) float64
            Normal force on each taxel in N.
        """
        found: list[tuple[float, float]] = []
        for taxels, xy_m in zip(self._taxels, self._xy_m, strict=True):
            weights = force_n[taxels]
            total_n = float(weights.sum())
            if not total_n > 0.0:
                return None
            x_m, y_m = weights @ xy_m / total_n
            found.append((float(x_m), float(y_m)))
        return found[0], found[1]
