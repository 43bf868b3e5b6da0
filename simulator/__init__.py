"""A simulated cell that uses the real protocols of the buses.

Servos are Protocol 2.0 devices, the tactile control unit is a CANopen device. Both share one world
in which rigid objects are pressed into foam pads. The package imports descriptions of the hardware
(registers, taxel layout, frame format, object dictionary), but never a driver. `simulated_cell`
makes a cell in virtual time; `simulator.realtime.process` runs one in real time.
"""

import lazy_loader

# The names stand in __init__.pyi. A module is imported at the first use of one of its names.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
