"""Errors of the tactile sensor; each message names cause, value, limit and remedy."""


class TactileError(Exception):
    """Base of all errors of the tactile sensor."""


class LayoutError(TactileError, ValueError):
    """A layout or a frame format that cannot exist, or that does not fit the unit."""


class FrameError(TactileError, ValueError):
    """A force table for the unit that is not finite."""


class CalibrationError(TactileError):
    """A calibration that does not fit the sensor, or a value outside of its range."""


class TareRefused(TactileError):
    """The zero was not taken: touched, drifting or noisy taxels, or too few frames."""


class ZeroDrifted(TactileError):
    """The zero of the taxels has moved since it was taken: forces and shapes are wrong by it."""


class ForceContradicted(TactileError):
    """The control unit's force messages and its frames show different forces."""


class LinkStateError(TactileError):
    """A call that the link does not allow in the state it is in."""


class LinkFault(TactileError):
    """The link to the control unit has failed; latched until a new start."""


class NodeMissing(LinkFault):
    """The control unit did not show up, or does not answer."""


class ObjectRefused(LinkFault):
    """The control unit refused to read or write an object: SDO abort, with its code in words."""


class IdentityMismatch(LinkFault):
    """Another unit than the expected one answers; the message lists expected and found."""


class HeartbeatLost(LinkFault):
    """The control unit's heartbeat stayed away."""


class DuplicateNode(LinkFault):
    """Two units answer under one node-ID; their messages cannot be separated."""


class BusDisturbed(LinkFault):
    """More foreign or damaged messages come than the link is allowed to pass over."""


class NodeRebooted(LinkFault):
    """The control unit restarted while in operation: its set-up and its zero are gone."""


class NodeStateChanged(LinkFault):
    """The control unit left the operational state."""


class NodeEmergency(LinkFault):
    """The control unit sent an emergency (EMCY) message."""


class BusOff(LinkFault):
    """The CAN controller is off the bus, or the interface does not work any more."""


class BusErrorPassive(LinkFault):
    """The CAN controller is error-passive for longer than allowed."""


class ReceiveLoopDead(LinkFault):
    """Nothing is received any more because the receiver ended, hangs or was overrun."""


class FrameTimeout(LinkFault):
    """Whole frames stay away although the control unit runs, or the values are frozen."""


class PluginFault(LinkFault):
    """The code of a sensor of another package failed, or returned a wrong value."""


class BusNotOpened(LinkFault):
    """The CAN bus could not be opened."""
