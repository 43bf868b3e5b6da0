"""Errors of the package: input that gives no surface, trajectory or recognizer.

All derive from ``ValueError``.
"""


class RecognitionError(ValueError):
    """Base class of the errors of this package."""


class ContactError(RecognitionError):
    """A pad shows no usable contact: no load above the noise, or frames that do not fit."""


class QuadricError(RecognitionError):
    """No quadric fits these points: too few, degenerate, or not finite."""


class TransformError(RecognitionError):
    """A matrix is not an invertible homogeneous transformation."""


class TrajectoryError(RecognitionError):
    """A sweep is too large, or its bands give no thresholds."""
