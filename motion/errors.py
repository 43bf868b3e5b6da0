"""Errors of axes: one small tree, each message names axis, cause, value, limit and remedy."""


class MotionError(Exception):
    """Base of all errors that the package ``motion`` raises on purpose."""


class AxisLimitExceeded(MotionError, ValueError):
    """A position outside the limits of an axis was asked for; nothing has moved."""


class PositionNotReached(MotionError):
    """An axis stands still or is still under way after the time that the way may take."""


class AxisMissing(MotionError):
    """A drive or servo does not answer at the start, or is another device than configured."""


class AxisSilent(MotionError):
    """A drive sends no heartbeat, or a drive or servo no answers, any more."""


class AxisRestarted(MotionError):
    """A drive or servo has lost its set-up and its position: it has booted."""


class AxisFault(MotionError):
    """A drive or servo reports a fault and has stopped by itself."""


class LimitSwitchReached(MotionError):
    """A limit switch has stopped an axis."""


class HomingFailed(MotionError):
    """An axis has not found its home."""


class AxisNotOperational(MotionError):
    """A drive has left the NMT state operational: another CANopen master commands it."""


class AxisDuplicated(MotionError):
    """Two drives on the bus have one node-ID."""


class AxisAnswerWrong(MotionError):
    """A drive answers, with something else than was asked for."""


class PositionImplausible(MotionError):
    """The position reading of an axis is beyond its limits; where the axis is, is not known."""
