"""The cell of a host program, for tests: the plugin that README loads, and its faults."""

from typing import Any

from cell.errors import CellStateError
from cell.runtime.plugin import TactileCellPlugin
from pytest_tactile_cell.process import AskedCell


class CellRuntime(TactileCellPlugin, AskedCell):
    """A `TactileCellPlugin` on simulated devices that takes the faults of a test."""

    @property
    def running(self) -> bool:
        """Whether it takes requests: false after `close`."""
        return not self._closed

    end = TactileCellPlugin.close

    def ask(self, **request: Any) -> dict[str, Any]:
        """Send a request to the simulated devices, for example ``state=True``; return the reply.

        Raises as `simulate`.
        """
        if self._closed:
            raise CellStateError("the cell is closed; load the plugin again")
        return self.simulate(request)
