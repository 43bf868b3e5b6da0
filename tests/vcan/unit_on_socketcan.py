"""A simulated control unit on a SocketCAN interface: python unit_on_socketcan.py CHANNEL NODE."""

import sys
import time
from types import SimpleNamespace

import can
import numpy as np

from simulator.can.control_unit import ControlUnitSettings, SimulatedControlUnit
from tactile.layout import paper_layout

LAYOUT = paper_layout()


def main() -> None:
    bus = can.Bus(sys.argv[1], interface="socketcan")
    settings = ControlUnitSettings(node_id=int(sys.argv[2]), serial_number=77)
    rng = np.random.default_rng(3)
    untouched = SimpleNamespace(scan=lambda: rng.integers(1, 20, LAYOUT.n_taxels, np.uint16))
    unit = SimulatedControlUnit(untouched, LAYOUT, settings, start_s=time.monotonic())

    def send(ready_s: float, can_id: int, burst: list[bytes]) -> float:
        for data in burst:
            bus.send(can.Message(arbitration_id=can_id, data=data, is_extended_id=False), 1.0)
        return ready_s

    unit.connect(send)
    sys.stdout.write("ready\n")
    sys.stdout.flush()
    while True:
        now_s = time.monotonic()
        unit.advance(now_s)
        message = bus.recv(min(0.02, max(0.0, unit.next_event_s() - now_s)))
        if message is not None:
            unit.receive(message.arbitration_id, bytes(message.data), time.monotonic())


if __name__ == "__main__":
    main()
