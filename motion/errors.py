"""Errors of axes: one small tree, each message names axis, cause, value, limit and remedy."""


class MotionError(Exception):
    """Base of all errors that the package ``motion`` raises on purpose."""


class AxisLimitExceeded(MotionError, ValueError):
    """A requested position is outside the limits of an axis; nothing has moved."""


class PositionNotReached(MotionError):
    """An axis has not reached its target in the longest time of the travel."""


class AxisMissing(MotionError):
    """A drive or servo is another device than configured, or refuses its set-up."""


class AxisSilent(MotionError):
    """A drive has stopped its heartbeat, or a drive or servo its answers."""


class AxisRestarted(MotionError):
    """A drive or servo has lost its set-up and its position: it has booted."""


class AxisFault(MotionError):
    """A drive or servo is at fault, stalled, outside its limits, or does not take a command."""


class LimitSwitchReached(MotionError):
    """A limit switch has stopped an axis."""


class HomingFailed(MotionError):
    """An axis has not found its home."""


class AxisNotOperational(MotionError):
    """A drive has left the NMT state operational: another CANopen master commands it."""


class AxisDuplicated(MotionError):
    """Two drives on the bus have one node-ID."""


class AxisAnswerWrong(MotionError):
    """A drive answers with something other than the request."""


class PositionImplausible(MotionError):
    """The position reading of an axis is beyond its limits; its position is unknown."""
