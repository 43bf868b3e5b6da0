"""The simulated sensors: real bytes, with a codec of their own."""

import struct

from simulator.boards.resistive import ResistivePads
from simulator.boards.site import SerialBoard

SCAN_S = 0.02


def crc16(data):  # the table-free form of the Modbus specification, bit by bit
    crc = 0xFFFF
    for bit in (byte >> n & 1 for byte in data for n in range(8)):
        crc = crc >> 1 ^ (0xA001 if crc & 1 ^ bit else 0)
    return struct.pack("<H", crc)


class DfrobotBoards:
    def __init__(self, addresses):
        self.addresses = addresses

    def serial_boards(self, site):
        return (DfrobotLine(0, site, addresses=self.addresses),)

    def can_device(self, site):
        return None


class DfrobotLine(SerialBoard):
    def __init__(self, line, site, *, addresses):
        super().__init__(line, site, baud_rate=921_600)
        self.addresses, self.request, self.scanned_s = addresses, b"", site.start_s
        self.pads = ResistivePads(site.world, site.layout, site.taxel_faults, seed=site.seed)
        self.counts = self.pads.scan()

    def advance_to(self, now_s):
        while self.scanned_s <= now_s - SCAN_S:
            self.scanned_s, self.counts = self.scanned_s + SCAN_S, self.pads.scan()

    def receive(self, data, now_s, *, sent_after_s=None):
        self.request = (self.request + data)[-8:]
        body, crc = self.request[:-2], self.request[-2:]
        if len(self.request) < 8 or crc16(body) != crc or body[0] not in self.addresses:
            return
        self.request, pad = b"", self.site.layout.gripping_pads[self.addresses.index(body[0])]
        cells = self.counts[self.site.layout.taxels_of(pad)].reshape(6, 6)[::-1].ravel()
        # The pads hand out 8 bit: 12 bit with the same full scale.
        answer = struct.pack(">BBB36H", body[0], 4, 72, *(16 * cells.astype(int)))
        self.send(answer + crc16(answer), now_s + 1e-3)
