"""A simulated cell that answers with the real bytes of the real buses.

Servos are Protocol 2.0 devices, the tactile control unit is a CANopen device, and both live in
one world in which rigid objects are pressed into foam pads. The package imports what describes
the hardware (registers, taxel layout, frame format, object dictionary) and never a driver.
`simulated_cell` makes one in virtual time; `simulator.realtime.process` is for real time.
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
"""Names by module, which is imported when one of them is first used."""
_HOMES = {name: home for home, names in _FACE.items() for name in names.split()}

__all__ = list(_HOMES)

if not TYPE_CHECKING:

    def __getattr__(name: str) -> object:
        if name not in _HOMES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        return getattr(import_module(_HOMES[name]), name)

    def __dir__() -> list[str]:
        return sorted({*globals(), *_HOMES})
