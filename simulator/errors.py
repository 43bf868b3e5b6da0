"""Errors of the simulator, one small tree; none of them stands for a fault of simulated hardware.

A simulated device that fails does so on its bus, as the real one would. These errors mean that the
simulator itself is used wrongly or lost something of the machine that it runs on.
"""

import math


class SimulatorError(Exception):
    """Base of all errors that the package ``simulator`` raises on purpose."""


class SimulatorSettingsError(SimulatorError, ValueError):
    """A setting or a fault knob is impossible; the message names it, its value and its limit."""


class SimulatorStateError(SimulatorError, RuntimeError):
    """Something was asked for in the wrong order, such as polling an endpoint that is closed."""


class PartGripped(SimulatorStateError):
    """An object is to be exchanged while the fingers hold one."""


class PortUnplugged(SimulatorError, OSError):
    """The simulated cable is out: reading and writing fail as on an adapter that went away."""


class EndpointError(SimulatorError, OSError):
    """A pseudo-terminal, symbolic link or socket of the machine could not be made or kept."""


def require_positive(**values: float) -> None:
    """Refuse values that are not positive and finite; SimulatorSettingsError names the first."""
    for name, value in values.items():
        if not (math.isfinite(value) and value > 0.0):
            raise SimulatorSettingsError(f"{name} is {value}, must be positive and finite")
