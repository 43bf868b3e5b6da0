"""What the tactile sensor is told, and what it gives."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from tactile.filters import Values
from tactile.protocol import TactileFrame
from tactile.quality import QualityLimits
from tactile.tare import TareLimits
from tactile.touch import TouchThresholds


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorSettings:
    """How frames become forces.

    The defaults suit 50 frames/s and one-sided noise of up to 8 % of the full scale on each taxel
    and frame; the thresholds follow the noise that the tare finds.

    Attributes
    ----------
    mean_frames
        Frames averaged: the force follows a step completely after so many.
    touch
        When a taxel counts as touched.
    noise_floor_share
        Noise of a taxel is taken to be at least this share of the full scale.
    gap_s
        A longer gap between frames starts the mean anew, in s.
    quality
        When samples are not believed any more.
    bad_share
        Forces are not ok with a larger share of bad taxels on a gripping pad.
    poll_s
        Pause between two polls while waiting, in s.
    tare_limits
        When a zero is refused.
    """

    mean_frames: int = 3
    touch: TouchThresholds = field(default_factory=TouchThresholds)
    noise_floor_share: float = 0.002
    gap_s: float = 0.1
    quality: QualityLimits = field(default_factory=QualityLimits)
    bad_share: float = 0.05
    poll_s: float = 0.001
    tare_limits: TareLimits = field(default_factory=TareLimits)

    def __post_init__(self) -> None:
        for name, low in (
            ("mean_frames", 1),
            ("gap_s", 0.0),
            ("bad_share", 0.0),
            ("noise_floor_share", 1e-6),
            ("poll_s", 1e-6),
        ):
            if not getattr(self, name) >= low:
                raise ValueError(f"{name} is {getattr(self, name)}, must be at least {low:g}")


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorStatistics:
    """What the sensor noted since its start.

    Attributes
    ----------
    bad_taxels
        Taxels that do not measure now; masked and filled from their neighbours.
    saturated_frames
        Frames with healthy taxels at full scale.
    void_frames
        Frames after the tare whose finger forces were not fit for control.
    """

    bad_taxels: int = 0
    saturated_frames: int = 0
    void_frames: int = 0


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TactileReading:
    """One frame and what it says in newtons. Arrays are read-only.

    Attributes
    ----------
    frame
        The raw frame.
    tared_counts : (n_taxels,) float64
        Counts above the zero, averaged over the last frames, bad taxels filled from neighbours.
    force_n : (n_taxels,) float64
        Normal force on each active taxel in N, 0 on the others.
    pad_force_n : (n_pads,) float64
        Sum over each pad in N.
    finger_force_n
        Force on the gripping pad of finger 0 and of finger 1 in N.
    active, saturated, bad : (n_taxels,) bool
        Touched taxels; taxels at full scale in this frame; taxels that do not measure: dead,
        stuck or constantly at full scale, filled from their neighbours.
    ok
        Whether the finger forces may be used for control.
    reason
        Why not, empty if ok.
    """

    frame: TactileFrame
    tared_counts: Values
    force_n: Values
    pad_force_n: Values
    finger_force_n: tuple[float, float]
    active: NDArray[np.bool_]
    saturated: NDArray[np.bool_]
    bad: NDArray[np.bool_]
    ok: bool
    reason: str

    @property
    def t_s(self) -> float:
        """Monotonic time of reception in s."""
        return self.frame.t_s
