"""Force messages on the CAN bus: load, wait behind a burst, and what the priority of COB-IDs gives.

The simulated unit at 1 Mbit/s sends 50 frames a second and its force messages; each is measured on
the wire, with noise on all taxels. The frames come before the force messages (their COB-IDs as the
EDS has them) or behind them (as the link sets them up).
"""

from collections import deque
from collections.abc import Sequence

import can
import numpy as np

from benchmarks._measure import line, repeats
from simulator.can.control_unit import SimulatedControlUnit
from simulator.can.memory_bus import InMemoryCanBus
from simulator.can.wire import mean_bits
from simulator.clock import VirtualClock
from simulator.servo.mechanics import FingerMechanics, ParallelogramLinkage, ServoMount
from simulator.servo.motor import ServoMotor
from simulator.world.world import PhysicalWorld
from tactile.control_unit import object_dictionary
from tactile.control_unit.link import TactileLink
from tactile.control_unit.settings import LinkSettings
from tactile.layout import paper_layout
from tactile.sensor.calibration import FoamCalibration
from tactile.sensor.opening import force_table

NODE_ID, BITRATE = 5, 1_000_000
PERIODS_MS = (0, 5, 3, 2)
SECONDS = 10.0


def measure(
    period_ms: int, *, frames_first: bool, seconds: float
) -> tuple[float, float, Sequence[float]]:
    """Return bus load and share of scans left out, 0 to 1, and the wait of each message in s."""
    layout, clock = paper_layout(), VirtualClock()
    motors = [ServoMotor() for _ in (0, 1)]
    mounts = [ServoMount(direction=direction) for direction in (1, -1)]
    fingers = FingerMechanics(motors, mounts, ParallelogramLinkage(), aperture_m=0.02)
    unit = SimulatedControlUnit(PhysicalWorld(layout, fingers), layout)
    bus = InMemoryCanBus(unit, clock, bitrate=BITRATE)
    link = TactileLink(
        bus,
        node_id=NODE_ID,
        layout=layout,
        clock=clock,
        settings=LinkSettings(threaded=False, force_period_s=1e-3 * period_ms),
        force_table=force_table(layout, FoamCalibration(layout.adc_max)),
    )
    link.start()
    if frames_first:
        unit.dictionary.pretend(
            object_dictionary.TPDO1_PARAMETER, 1, object_dictionary.COB_TPDO1 + NODE_ID
        )
        unit.command("OPERATIONAL", clock.monotonic())
    force_id = object_dictionary.COB_TPDO2 + NODE_ID
    bits = 0.0
    ready_s: deque[float] = deque()
    waits_s: list[float] = []

    def listen(t_s: float, can_id: int, data: bytes) -> None:
        nonlocal bits
        bits += mean_bits(data)
        if can_id == force_id and ready_s:
            waits_s.append(t_s - mean_bits(data) / BITRATE - ready_s.popleft())

    def send(at_s: float, can_id: int, burst: list[bytes]) -> float:
        if can_id == force_id:
            ready_s.append(at_s)
        return put(at_s, can_id, burst)

    put = unit.send
    unit.connect(send)
    bus.capture.append(listen)
    start_s = clock.monotonic()
    while clock.monotonic() < start_s + seconds:
        clock.sleep(0.001)
        # Under the COB-IDs of the EDS the link does not know its frames again: SYNC alone then.
        if frames_first:
            if round(1e3 * (clock.monotonic() - start_s)) % 20 == 0:
                bus.send(can.Message(arbitration_id=0x80, is_extended_id=False))
        else:
            link.poll()
    bus.shutdown()
    due = 1e3 * seconds / period_ms if period_ms else 0.0
    return (
        bits / BITRATE / seconds,
        max(0.0, 1.0 - (len(waits_s) + 1) / due) if due else 0.0,
        waits_s,
    )


def main(effort: float = 1.0) -> None:
    """Measure and print."""
    seconds = repeats(round(SECONDS), effort)
    line("compared", f"messages and frames of one unit for {seconds} s, either first")
    for period_ms in PERIODS_MS:
        for frames_first in (False, True) if period_ms else (False,):
            load, left_out, waits_s = measure(period_ms, frames_first=frames_first, seconds=seconds)
            what = f"{1e3 / period_ms:.0f} a second" if period_ms else "none"
            order = ", frames first" if frames_first else ", forces first" if period_ms else ""
            waited = (
                f", wait mean {1e3 * float(np.mean(waits_s)):.2f} ms, "
                f"worst {1e3 * max(waits_s):.2f} ms, left out {100 * left_out:.1f} %"
                if waits_s
                else ""
            )
            line(f"  {what}{order}", f"bus load {100 * load:.1f} %{waited}")
