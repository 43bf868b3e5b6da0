"""A sensor of another package, whose code goes wrong as soon as a file is there."""

import threading
from pathlib import Path
from typing import Any, Literal

from cell.config.sensor import SensorLines
from cell.config.tactile import TactileConfig
from cell.sensors.control_unit import ControlUnitConfig
from tactile.source import Arrivals, FrameSource


class FaultyConfig(ControlUnitConfig):
    """The control unit, with a defect."""

    kind: Literal["faulty"]  # type: ignore[assignment]
    trigger: str
    how: Literal["blocks", "spins", "raises"]

    def open_source(self, tactile: TactileConfig, lines: SensorLines) -> FrameSource:
        source: Any = super().open_source(tactile, lines)
        sound_poll, trigger = source.poll, Path(self.trigger)

        def poll() -> Arrivals:
            if trigger.exists():
                if self.how == "blocks":
                    threading.Event().wait()
                while self.how == "spins":
                    pass
                raise ZeroDivisionError("division by zero")
            arrivals: Arrivals = sound_poll()
            return arrivals

        source.poll = poll
        return source
