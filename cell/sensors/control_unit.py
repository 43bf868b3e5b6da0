"""The CANopen control unit as a kind of `tactile.sensor`."""

from math import ceil
from typing import Literal

from cell.config.section import MILLI
from cell.config.sensor import SensorConfig, SensorLines
from cell.config.tactile import (
    FASTEST_BITRATE,
    LONGEST_SYNC_MS,
    TactileConfig,
    layout_from_config,
    link_settings,
    make_calibration,
)
from tactile.control_unit.settings import WINDOW_SHARE, bus_load, least_sync_period_s
from tactile.frames import FrameFormat
from tactile.layout import TaxelLayout
from tactile.source import FrameSource


class ControlUnitConfig(SensorConfig):
    """A CANopen control unit, described by the keys beside `sensor`."""

    kind: Literal["control_unit"] = "control_unit"
    """Kind of the device that reads the pads."""
    canopen = True
    on_can = True

    def frame_period_s(self, tactile: TactileConfig) -> float:
        """Return the period of SYNC in s."""
        return MILLI * tactile.sync_period_ms

    def sends_forces(self, tactile: TactileConfig) -> bool:
        """Return whether the config requests forces."""
        return tactile.force_period_ms > 0

    def check(self, tactile: TactileConfig, layout: TaxelLayout) -> None:
        """Raise ValueError for frames and forces that exceed the capacity of its bus."""
        link = link_settings(tactile)
        least_ms = {
            rate: 1e3 * least_sync_period_s(layout, link, rate)
            for rate in (tactile.bitrate, FASTEST_BITRATE)
        }
        if least_ms[tactile.bitrate] <= tactile.sync_period_ms:
            return
        ways = [
            f"tactile.bitrate {rate} with tactile.sync_period_ms {ceil(period_ms)} or more"
            for rate, period_ms in least_ms.items()
            if period_ms <= LONGEST_SYNC_MS
        ]
        raise ValueError(
            f"tactile: at tactile.bitrate = {tactile.bitrate} the control unit loads the bus by up "
            f"to {bus_load(layout, link, tactile.bitrate):.0%}: "
            f"{FrameFormat.of(layout).n_messages} messages per frame, which must be sent within "
            f"{WINDOW_SHARE:.0%} of tactile.sync_period_ms = {tactile.sync_period_ms:g}, and "
            f"force messages every tactile.force_period_ms = {tactile.force_period_ms}. Write "
            f"{', or '.join(ways) or 'a layout of fewer taxels'}"
        )

    def open_source(self, tactile: TactileConfig, lines: SensorLines) -> FrameSource:
        """Return the link to the unit; raises BusNotOpened where there is no bus."""
        from tactile.control_unit.node import TactileLink

        layout = layout_from_config(tactile)
        return TactileLink(
            lines.can_bus,
            node_id=tactile.node_id,
            layout=layout,
            settings=link_settings(tactile),
            force_law=make_calibration(tactile, layout).force_n,
            reopen=lines.reopen_can,
        )

    def simulated(self) -> None:
        """Return None: the unit is part of the simulator."""
