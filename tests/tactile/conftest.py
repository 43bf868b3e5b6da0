"""The link and a simulated control unit on a bus in memory, and ways to spoil what it sends."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack

import can
import numpy as np
import pytest

from simulator.can.control_unit import ControlUnitSettings, SimulatedControlUnit
from simulator.can.link import CanLink, InMemoryCanBus
from simulator.cell import SimulatedCell
from simulator.clock import VirtualClock
from tactile.control_unit.node import TactileLink
from tactile.control_unit.settings import LinkSettings
from tactile.frames import ForceLaw
from tactile.layout import TaxelLayout, paper_layout
from tactile.sensor.calibration import Calibration
from tactile.source import Arrivals, ForceMessage, FrameSource, TactileFrame

NODE = 5
BOOT_S = 0.05


def counts_of(law: Calibration, force_n: np.ndarray) -> np.ndarray:
    """Return the tared counts, not rounded, that a law of equal taxels reads as forces in N."""
    counts = np.linspace(-law.adc_max, law.adc_max, 20_001)
    return np.interp(force_n, law.force_n(counts), counts)


class Skin:
    """Taxels that read `counts`, with the paper's noise where `noisy`."""

    def __init__(self, layout: TaxelLayout) -> None:
        self.counts = np.zeros(layout.n_taxels, dtype=np.uint16)
        self.noisy = False
        self.scans = 0
        self._rng = np.random.default_rng(1)
        self._adc_max = layout.adc_max

    def scan(self) -> np.ndarray:
        self.scans += 1
        if not self.noisy:
            return self.counts.copy()
        noise = np.rint(np.clip(np.abs(self._rng.normal(0, 10, len(self.counts))), 1, 20))
        return np.minimum(self.counts + noise.astype(np.uint16), self._adc_max)

    scan_gripping = scan


class Bench:
    """Link, unit, bus and clock together; the unit has booted."""

    def __init__(
        self,
        layout: TaxelLayout,
        *,
        unit: ControlUnitSettings | None = None,
        law: ForceLaw | None = None,
        **settings: object,
    ) -> None:
        self.clock = VirtualClock(100.0)
        self.skin = Skin(layout)
        self.unit = SimulatedControlUnit(self.skin, layout, unit, start_s=100.0)
        self.bus = InMemoryCanBus(CanLink(self.unit), self.clock)
        self.traffic: list[tuple[float, int, bytes]] = []
        self.bus.capture.append(lambda t_s, can_id, data: self.traffic.append((t_s, can_id, data)))
        self.link = TactileLink(
            self.bus,
            node_id=NODE,
            layout=layout,
            settings=LinkSettings(**settings),  # type: ignore[arg-type]
            force_law=law,
        )
        self.clock.sleep(BOOT_S)

    def run(self, seconds: float, step_s: float = 0.005) -> list[TactileFrame]:
        arrivals = polled(self.clock, self.link, seconds, step_s)
        return [frame for arrived in arrivals for frame in arrived.frames]

    def forces(self, seconds: float) -> list[ForceMessage]:
        """Run for so long and return the force messages that came."""
        arrivals = polled(self.clock, self.link, seconds, 0.001)
        return [message for arrived in arrivals for message in arrived.forces]

    def put(self, cob_id: int, data: bytes, **options: object) -> None:
        """Let the host receive a message now, past wire and unit."""
        options = {"is_extended_id": False, "timestamp": self.clock.monotonic()} | options
        message = can.Message(arbitration_id=cob_id, data=data, **options)  # type: ignore[arg-type]
        self.bus._link._inbox.append(message)

    def alter(self, cob_id: int, change: Callable[[list[bytes]], list[bytes]]) -> None:
        """Let what the unit sends under an identifier pass through a function from now on."""
        send = self.unit.send

        def altered(ready_s: float, can_id: int, burst: list[bytes]) -> float:
            if can_id != cob_id:
                return send(ready_s, can_id, burst)
            changed = change(burst)
            return send(ready_s, can_id, changed) if changed else ready_s

        self.unit.send = altered


def polled(
    clock: VirtualClock, source: FrameSource, seconds: float, step_s: float = 0.005
) -> Iterator[Arrivals]:
    """Poll a source for so long, by default at the rate of a force loop."""
    for _ in range(round(seconds / step_s)):
        clock.sleep(step_s)
        yield source.poll()


def run(cell: SimulatedCell, source: FrameSource, seconds: float) -> list[TactileFrame]:
    """Poll the source of boards and return the frames."""
    return [frame for arrived in polled(cell.clock, source, seconds) for frame in arrived.frames]


@pytest.fixture
def make_bench(undo: ExitStack) -> Callable[..., Bench]:
    def make(layout: TaxelLayout | None = None, **settings: object) -> Bench:
        bench = Bench(layout or paper_layout(), **settings)  # type: ignore[arg-type]
        undo.callback(bench.bus.shutdown)
        undo.callback(bench.link.stop)
        return bench

    return make


@pytest.fixture
def idle(make_bench: Callable[..., Bench]) -> Bench:
    """A bench whose link is not started."""
    return make_bench(unit=ControlUnitSettings(serial_number=4711, boards=(31, 32)))


@pytest.fixture
def bench(idle: Bench) -> Bench:
    """A bench whose link is in operation."""
    idle.link.start()
    return idle
