"""A link and a sensor that were started and zeroed on a simulated unit, then fed by another one."""

import time
from contextlib import AbstractContextManager

from benchmarks.performance._child import Child, running
from benchmarks.performance._frame_feed import LAYOUT, NODE_ID, FeedBus
from simulator.cell import SimulatedCell
from simulator.settings import SimulatorSettings
from tactile.can.bus import BulkSlcanBus
from tactile.can.receiver import MessageSource, PolledSource, Stamped, ThreadedReceiver
from tactile.sensor.calibration import FoamCalibration
from tactile.sensor.sensor import TactileSensor
from tactile.unit.link import LinkSettings, TactileLink

TARE_FRAMES = 50
_QUICK_BITRATE = 20_000_000


class HandedClock:
    """The clock of the simulated cell, and from `hand_over` on the real one, without a jump."""

    def __init__(self, cell: SimulatedCell) -> None:
        self._virtual = cell.clock
        self._real_since_s: float | None = None

    def monotonic(self) -> float:
        now_s = self._virtual.monotonic()
        return (
            now_s if self._real_since_s is None else now_s + time.monotonic() - self._real_since_s
        )

    def sleep(self, seconds: float, /) -> None:
        (self._virtual if self._real_since_s is None else time).sleep(seconds)

    def hand_over(self) -> None:
        """Let the time pass by itself."""
        self._real_since_s = time.monotonic()


class HandedSource:
    """A source of messages that another one takes the place of."""

    def __init__(self, inner: MessageSource) -> None:
        self.inner = inner

    def start(self) -> None:
        self.inner.start()

    def drain(self) -> list[Stamped]:
        return self.inner.drain()

    def wait(self, timeout_s: float) -> None:
        self.inner.wait(timeout_s)

    def close(self) -> None:
        self.inner.close()


class FedSensor:
    """A sensor that has been zeroed; from then on nothing of the simulator runs.

    Attributes
    ----------
    next_counter
        Frame counter that the sensor expects next.
    """

    def __init__(self, sync_period_s: float) -> None:
        # Its wire is quick enough for every period that is asked for later.
        cell = SimulatedCell(SimulatorSettings(can_bitrate=_QUICK_BITRATE))
        self.clock = HandedClock(cell)
        self.virtual = cell.clock
        self.bus = FeedBus(cell.can_bus)
        self.source = HandedSource(PolledSource(self.bus, self.clock))
        self.link = TactileLink(
            self.bus,
            node_id=NODE_ID,
            layout=LAYOUT,
            clock=self.clock,
            # Only losses count here: a machine that others use too holds frames up now and then.
            settings=LinkSettings(
                sync_period_s=sync_period_s,
                frame_timeout_periods=1000,
                late_periods=1000,
                max_loss_rate=1.0,
                heartbeat_factor=10.0,
            ),
            source=self.source,
        )
        calibration = FoamCalibration(adc_max=LAYOUT.adc_max)
        self.sensor = TactileSensor(self.link, LAYOUT, calibration, clock=self.clock)
        self.sensor.start()
        self.offset_counts = self.sensor.tare(TARE_FRAMES).offset_counts
        self.next_counter = self.sensor.read().frame.counter + 1
        self.bus.inner = None
        cell.close()
        self.virtual.on_advance.clear()

    def hand_over(self, port: str) -> None:
        """Go on in real time on a serial adapter, with the receive thread of a real cell."""
        self.bus.inner = BulkSlcanBus(port, bitrate=1_000_000, tty_baudrate=1_000_000)
        self.source.inner = ThreadedReceiver(self.bus.inner, self.clock)
        self.source.inner.start()
        self.clock.hand_over()

    def close(self) -> None:
        """End the sensor and its buses."""
        self.sensor.close()
        if self.bus.inner is not None:
            self.bus.inner.shutdown()
        self.bus.shutdown()


class Unit(Child):
    """The process of `benchmarks.performance._slcan_unit`."""

    def go_on_from(self, counter: int, n_frames: int) -> None:
        """Choose the counter of its next frame; returns when so many frames are made."""
        self.order(counter=counter, frames=n_frames)


def slcan_unit() -> AbstractContextManager[Unit]:
    """Run the control unit while the context lasts."""
    return running(Unit, "benchmarks.performance._slcan_unit")
