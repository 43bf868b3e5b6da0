from .cell import SimulatedCell as SimulatedCell, simulated_cell as simulated_cell
from .settings import SimulatorSettings as SimulatorSettings
