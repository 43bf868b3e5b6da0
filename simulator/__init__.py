"""A simulated cell that uses the real protocols of the buses.

Servos are Protocol 2.0 devices, the tactile control unit is a CANopen device. Both share one world
in which rigid objects are pressed into foam pads. The package imports descriptions of the hardware
(registers, taxel layout, frame format, object dictionary), but never a driver. `simulated_cell`
makes a cell in virtual time; `simulator.realtime.process` runs one in real time.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from simulator.cell import SimulatedCell as SimulatedCell, simulated_cell as simulated_cell
    from simulator.settings import SimulatorSettings as SimulatorSettings

_FACE = {
    "simulator.cell": "SimulatedCell simulated_cell",
    "simulator.settings": "SimulatorSettings",
}
"""Names by module; a module is imported at the first use of one of its names."""
_HOMES = {name: home for home, names in _FACE.items() for name in names.split()}

__all__ = list(_HOMES)

if not TYPE_CHECKING:

    def __getattr__(name: str) -> object:
        if name not in _HOMES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        return getattr(import_module(_HOMES[name]), name)

    def __dir__() -> list[str]:
        return sorted({*globals(), *_HOMES})
