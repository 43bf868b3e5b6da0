"""Two DFRobot SEN0704 (6 x 6 taxels, 12 bit) on one RS-485 line: Modbus RTU at 921,600 bit/s."""

from typing import Literal

import numpy as np

from cell.config.sensor import RestLimits, SensorConfig
from gripper.errors import PortLost
from tactile.board_source import BoardSource
from tactile.errors import LayoutError

ANSWER_S = 0.015  # the answer of one sensor takes 1 ms on the line
PAD = {"face": "inner", "rows": 6, "columns": 6, "pitch_x_mm": 3.0, "pitch_y_mm": 3.0}
LAYOUT = {  # 3 mm is assumed: measure it
    "name": "dfrobot_6x6",
    "pads": [{"finger": 0, **PAD}, {"finger": 1, **PAD}],
    "adc_max": 4095,
}


class DfrobotConfig(SensorConfig):
    """Two DFRobot SEN0704 on one line."""

    kind: Literal["dfrobot"]
    ports: tuple[str] = ("simulated",)
    addresses: tuple[int, int] = (1, 2)
    layout, baud_rate, period_s = LAYOUT, 921_600, 0.02
    rest = RestLimits(rest_share=0.25, bump_share=0.05)

    def check(self, tactile, layout):
        if [(pad.finger, pad.rows, pad.columns) for pad in layout.pads] != [(0, 6, 6), (1, 6, 6)]:
            raise LayoutError(f"layout {layout.name} is not one pad of 6 x 6 on each finger")

    def open_source(self, tactile, lines):
        return DfrobotSource(lines.open_serial[0], self.addresses, clock=lines.clock,
                             period_s=self.period_s, **tactile.source_options)  # fmt: skip

    def simulated(self):
        from tactile_dfrobot.simulated import DfrobotBoards

        return DfrobotBoards(self.addresses)


class DfrobotSource(BoardSource):
    def __init__(self, open_line, addresses, **options):
        super().__init__("DFRobot SEN0704", line_errors=(OSError, PortLost), **options)
        self.open_line, self.addresses, self.line = open_line, addresses, None

    def open(self):
        self.line, self.pads = self.open_line(), []
        self.ask()

    def ask(self):
        """Ask the sensor whose pad comes next for its cells."""
        self.address = self.addresses[len(self.pads)]
        self.answer, self.asked_s = b"", self.clock.monotonic()
        self.line.drop_input()
        self.line.write(with_crc(bytes((self.address, 4, 0, 7, 0, 36))))

    def receive(self, now_s):
        self.answer += self.line.read(256, 0.0)
        if len(self.answer) < 77 and now_s - self.asked_s < ANSWER_S:
            return []
        head, body = bytes((self.address, 4, 72)), self.answer[:-2]
        if self.answer[:3] != head or with_crc(body) != self.answer or len(body) != 75:
            self.damaged()
        else:  # the last row comes first
            self.pads.append(np.frombuffer(body[3:], ">u2").reshape(6, 6)[::-1])
        whole, self.pads = (self.pads, []) if len(self.pads) == 2 else (None, self.pads)
        begun_s = self.asked_s - ANSWER_S
        self.ask()
        return [(begun_s, np.ravel(whole).astype(np.uint16))] if whole else []

    def close(self):
        if self.line is not None:
            self.line.close()


def with_crc(data):
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ 0xA001 * (crc & 1)
    return data + crc.to_bytes(2, "little")
