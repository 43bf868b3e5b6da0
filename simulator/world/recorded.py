"""A world that plays recorded grasps: real frames over the simulated links."""

import math

import numpy as np
from numpy.typing import NDArray

from simulator.clock import ROUNDING_S
from simulator.errors import SimulatorSettingsError
from simulator.world.world import STEP_S, Fingers
from tactile.layout import TaxelLayout


class RecordedWorld:
    """Plays one recorded grasp: each scan takes the next frame, and the fingers follow it.

    Before the first grasp the pads read zero. The last frame of a grasp stays, as in a hold; when
    `remaining` is 0 the next grasp can be loaded. A recording has no contact forces, so
    `contact_force_n` is zero and the servos' currents are those of free fingers.

    Parameters
    ----------
    layout
        The taxels of the frames.
    fingers
        The mechanics that follow the recorded aperture.
    """

    def __init__(self, layout: TaxelLayout, fingers: Fingers, *, start_s: float = 0.0) -> None:
        self._layout = layout
        self._gripping = np.isin(layout.taxel_pad, layout.gripping_pads)
        self._fingers = fingers
        self._time_s = start_s
        self._counts = np.zeros((0, layout.n_taxels), dtype=np.uint16)
        self._aperture_m: list[float] = []
        self._frame = np.zeros(layout.n_taxels, dtype=np.uint16)
        self._next = 0

    @property
    def remaining(self) -> int:
        """Number of frames of the loaded grasp that no scan has taken yet."""
        return len(self._counts) - self._next

    def load(self, counts: NDArray[np.uint16], aperture_m: NDArray[np.float64]) -> None:
        """Load a grasp to play from its first frame; the fingers move to its first aperture.

        Raises SimulatorSettingsError if the frames are not of this layout.

        Parameters
        ----------
        counts
            (n, n_taxels): frames in the order of time.
        aperture_m
            (n,): opening between the fingers in m; NaN leaves the fingers where they are.
        """
        if counts.shape[1:] != (self._layout.n_taxels,):
            raise SimulatorSettingsError(
                f"counts have shape {counts.shape}, layout {self._layout.name} needs "
                f"(n, {self._layout.n_taxels})"
            )
        self._counts, self._aperture_m, self._next = counts, aperture_m.tolist(), 0
        self._drive()

    def advance_to(self, now_s: float) -> None:
        """Advance the servos to ``now_s`` s."""
        while self._time_s + STEP_S <= now_s + ROUNDING_S:
            self._time_s += STEP_S
            self._fingers.step(STEP_S, (0.0, 0.0), (0.0, 0.0))

    def skip_to(self, now_s: float) -> None:
        """Leave out the time until ``now_s`` s: nothing has happened meanwhile."""
        self._time_s = max(self._time_s, now_s)

    def contact_force_n(self) -> tuple[float, float]:
        """Return zeros: the record has no contact forces."""
        return 0.0, 0.0

    def scan(self) -> NDArray[np.uint16]:
        """Take the next frame of the grasp, or the last one again; counts (n_taxels,)."""
        if self._next < len(self._counts):
            self._drive()
            self._frame = self._counts[self._next]
            self._next += 1
        return self._frame.copy()

    def scan_gripping(self) -> NDArray[np.uint16]:
        """Return the gripping pads of the frame that was taken last; counts (n_taxels,)."""
        return np.where(self._gripping, self._frame, 0).astype(np.uint16)

    def _drive(self) -> None:
        aperture_m = self._aperture_m[self._next]
        if not math.isnan(aperture_m):
            self._fingers.drive_to(aperture_m)
