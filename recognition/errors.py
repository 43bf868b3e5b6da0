"""Errors of the package: input from which no surface, trajectory or recogniser can be made.

All derive from ``ValueError``.
"""


class RecognitionError(ValueError):
    """Base class of the errors of this package."""


class ContactError(RecognitionError):
    """A pad shows no usable contact: nothing over the noise, or frames that do not fit."""


class QuadricError(RecognitionError):
    """No quadric fits these points: too few, degenerate, or not finite."""


class TransformError(RecognitionError):
    """A matrix is not an invertible homogeneous transformation."""


class TrajectoryError(RecognitionError):
    """A sweep is too large, or its bands cannot be turned into thresholds."""
