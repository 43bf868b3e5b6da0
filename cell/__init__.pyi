from .build import Cell as Cell, build_cell as build_cell
from .config.file import load_config as load_config
from .config.model import CellConfig as CellConfig
from .control.controller import CellController as CellController
from .errors import CellError as CellError
from .runtime.plugin import TactileCellPlugin as TactileCellPlugin
