"""What can go wrong between a grasp and a name.

All derive from ``ValueError``: the numbers that came in do not carry what was asked of them.
"""


class RecognitionError(ValueError):
    """Any refusal of this package."""


class ContactError(RecognitionError):
    """A pad shows no usable contact: nothing over the noise, or frames that do not fit."""


class QuadricError(RecognitionError):
    """No quadric can be told from these points: too few, degenerate, or not finite."""


class TransformError(RecognitionError):
    """A matrix is not an invertible homogeneous transformation."""


class TrajectoryError(RecognitionError):
    """A sweep is too large, or its bands cannot be turned into thresholds."""


class MissingExtraError(RecognitionError):
    """A recogniser cannot be taught: the library that teaches it is not installed."""
