"""XELA uSkin as a kind of `tactile.sensor`."""

from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import Field

from cell.config.section import Section
from cell.config.sensor import RestLimits, SensorConfig, SensorLines
from cell.config.tactile import TactileConfig
from tactile.layout import TaxelLayout
from tactile.source import FrameSource
from tactile.uskin import messages

if TYPE_CHECKING:
    from simulator.boards.site import SimulatedBoards

Identifier = Annotated[int, Field(ge=0, le=0x7FF)]


class UskinBoardConfig(Section):
    """CAN identifiers of one uSkin board, which differ between generations."""

    start: Identifier
    """Identifier of the message 07 00 that starts the board."""
    taxels: tuple[Identifier, ...] = Field(min_length=1, max_length=64)
    """Identifier of each taxel, row by row along the finger."""


class UskinConfig(SensorConfig):
    """Two uSkin boards on the bus of `interface`, `channel` and `bitrate`, without CANopen nodes.

    It uses z of the three axes, and records x and y. The keys for SYNC, heartbeat, force messages
    and serial numbers do not apply.
    """

    kind: Literal["uskin"]
    """Kind of the device that reads the pads."""
    boards: tuple[UskinBoardConfig, UskinBoardConfig] = (
        UskinBoardConfig(**asdict(messages.xr1944(1))),
        UskinBoardConfig(**asdict(messages.xr1944(2))),
    )
    """The boards on finger 0 and finger 1; the default is an XR1944 at address 1 and one at 2."""
    falling: bool = False
    """Whether z falls under a force."""
    zero_frames: int = Field(default=20, ge=8, le=500)
    """Frames of the zero before each approach, because z drifts, 8 to 500."""
    on_can = True
    lone_on_can = (
        "uSkin boards use identifiers of CANopen (201h is RPDO1 of node 1, 710h to 71Fh are "
        "heartbeats)"
    )
    layout = "uskin_4x4"
    period_s = messages.PERIOD_S
    # z of a taxel rests at 9312h, and 26 counts are a hundredth of a newton. [derived]
    rest = RestLimits(rest_share=0.75, bump_share=0.05, noise_share=4e-4)

    @property
    def fresh_zero_frames(self) -> int:
        """Frames of the zero before each approach."""
        return self.zero_frames

    def _ids(self) -> list[messages.BoardIds]:
        return [messages.BoardIds(start=board.start, taxels=board.taxels) for board in self.boards]

    def check(self, _tactile: TactileConfig, layout: TaxelLayout) -> None:
        """Raise LayoutError where a layout has other pads than the boards' taxels."""
        messages.check_layout(layout, self._ids())

    def open_source(self, tactile: TactileConfig, lines: SensorLines) -> FrameSource:
        """Return the source of both boards."""
        from tactile.uskin.source import UskinSource

        return UskinSource(
            lines.can_bus,
            self._ids(),
            clock=lines.clock,
            falling=self.falling,
            reopen=lines.reopen_can,
            **tactile.source_options,
        )

    def simulated(self) -> "SimulatedBoards":
        """Return both boards."""
        from simulator.boards.uskin import UskinBoard, UskinSettings

        first, second = (
            UskinBoard(start_id=board.start, taxel_ids=board.taxels) for board in self.boards
        )
        return UskinSettings(boards=(first, second), falling=self.falling)
