"""FlexiTac as a kind of `tactile.sensor`."""

from typing import TYPE_CHECKING, Literal

from cell.config.section import SIMULATED
from cell.config.sensor import RestLimits, SensorConfig, SensorLines
from cell.config.tactile import TactileConfig
from gripper.errors import PortLost
from tactile.flexitac import BAUD_RATE, PERIOD_S, PROFILES, FlexiTacSource, check_layout
from tactile.layout import TaxelLayout
from tactile.source import FrameSource

if TYPE_CHECKING:
    from simulator.boards.site import SimulatedBoards


class FlexiTacConfig(SensorConfig):
    """Two FlexiTac boards, one on each finger.

    The keys beside `sensor` for CAN, SYNC, heartbeat, force messages and serial numbers do not
    apply.
    """

    kind: Literal["flexitac"]
    """Kind of the device that reads the pads."""
    ports: tuple[str, str] = (SIMULATED, SIMULATED)
    """Serial ports of the boards on finger 0 and 1, preferably below /dev/serial/by-id; boards
    without serial numbers: below /dev/serial/by-path."""
    profile: Literal["12x32", "16x32", "16x16"] = "12x32"
    """Rows and columns that the boards send."""
    rows_along: bool = False
    """Whether a board's rows follow each other along the finger. Otherwise they follow across it,
    so that the long side of 12x32 lies along the finger."""
    baud_rate = BAUD_RATE
    layout = "flexitac_12x32"
    period_s = PERIOD_S
    # Each taxel rests at its own 10 to 40 of 255 counts. The mean of a taxel and its neighbours, at
    # a corner of four in all, deviates by at most this far from that of the pad. [derived] A taxel
    # of 8 bit may repeat itself for a second. [chosen]
    rest = RestLimits(rest_share=0.22, bump_share=0.06, stuck_frames=100)

    def check(self, _tactile: TactileConfig, layout: TaxelLayout) -> None:
        """Raise LayoutError where a layout has other pads than two of the profile's size."""
        check_layout(layout, PROFILES[self.profile], rows_along=self.rows_along)

    def open_source(self, tactile: TactileConfig, lines: SensorLines) -> FrameSource:
        """Return the source of both boards."""
        return FlexiTacSource(
            lines.open_serial,
            profile=PROFILES[self.profile],
            clock=lines.clock,
            rows_along=self.rows_along,
            line_errors=(OSError, PortLost),
            **tactile.source_options,
        )

    def simulated(self) -> "SimulatedBoards":
        """Return both boards."""
        from simulator.boards.flexitac import FlexiTacSettings

        size = PROFILES[self.profile]
        return FlexiTacSettings(rows=size.rows, columns=size.columns, rows_along=self.rows_along)
