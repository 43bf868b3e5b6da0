"""Errors of the simulator, in one tree; they are not faults of simulated hardware.

A failing simulated device fails on its bus, like the real device. These errors mean wrong use of
the simulator, or a lost resource of this machine.
"""

import math


class SimulatorError(Exception):
    """Base of all errors that the package ``simulator`` raises on purpose."""


class SimulatorSettingsError(SimulatorError, ValueError):
    """A setting or fault value is impossible; the message has its name, value and limit."""


class SimulatorStateError(SimulatorError, RuntimeError):
    """A call is not allowed in this state, for example polling a closed endpoint."""


class PartGripped(SimulatorStateError):
    """The object cannot be replaced while the fingers hold it."""


class PortUnplugged(SimulatorError, OSError):
    """The simulated cable is unplugged: reading and writing fail as with a removed adapter."""


class EndpointError(SimulatorError, OSError):
    """A pseudo-terminal, symbolic link or socket could not be created or kept."""


def require_positive(**values: float) -> None:
    """Refuse values that are not positive and finite; SimulatorSettingsError names the first."""
    for name, value in values.items():
        if not (math.isfinite(value) and value > 0.0):
            raise SimulatorSettingsError(f"{name} is {value}, must be positive and finite")
