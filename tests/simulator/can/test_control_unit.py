"""The simulated control unit: services, frames, forces, exact vectors of its bursts."""

import struct
from dataclasses import replace

import canopen
import numpy as np
import pytest
from canopen.sdo import SdoClient

from simulator.can.control_unit import EMCY_OVERRUN, EMCY_WINDOW, SimulatedControlUnit
from simulator.can.faults import ControlUnitFaults
from simulator.can.scanner import BurstFormat, PadForces
from tactile.control_unit import object_dictionary as od
from tactile.frames import (
    FrameAssembler,
    FrameFormat,
    decode_force_message,
    encode_zero,
    force_table,
)
from tactile.layout import TaxelLayout, paper_layout, pinch_layout
from tactile.sensor.calibration import Calibration, FoamCalibration, TableCalibration
from tactile.source import ForceMessage, ScanStatus, TactileFrame
from tests.simulator.conftest import DeviceLine
from tests.tactile.conftest import Skin, counts_of

NMT, SYNC, EMCY, TPDO1, SDO_OUT, SDO_IN, HEARTBEAT = 0, 0x80, 0x85, 0x185, 0x585, 0x605, 0x705
START, STOP, PRE_OPERATIONAL, RESET_NODE, RESET_COMMUNICATION = 1, 2, 128, 129, 130


class Line(DeviceLine):
    """A unit on a line on which a message takes 100 us."""

    def __init__(self) -> None:
        self.layout = paper_layout()
        self.skin = Skin(self.layout)
        self.skin.counts[:] = 3
        self.unit = SimulatedControlUnit(self.skin, self.layout)
        super().__init__(self.unit, message_s=100e-6)
        self.client = SdoClient(SDO_IN, SDO_OUT, od.of_node(5))
        self.client.network = self
        self.subscribe(SDO_OUT, self.client.on_response)
        self.wait(0.05)
        self.take()

    def tell(self, can_id: int, data: bytes = b"") -> list[tuple[int, bytes]]:
        """Send a message and return what comes back at once."""
        self.send_message(can_id, data)
        return self.take()

    def take(self) -> list[tuple[int, bytes]]:
        heard, self.heard = self.heard, []
        return heard

    def write(self, index: int, sub: int, value: int | bytes, size: int = 0) -> int:
        """Write an object; returns the abort code, 0 for success."""
        data = value if isinstance(value, bytes) else value.to_bytes(size, "little")
        try:
            self.client.download(index, sub, data)
        except canopen.SdoAbortedError as refusal:
            return refusal.code
        finally:
            self.take()
        return 0

    def read(self, index: int, sub: int = 0) -> bytes:
        try:
            return self.client.upload(index, sub)
        finally:
            self.take()

    def number(self, index: int, sub: int = 0) -> int:
        return int.from_bytes(self.read(index, sub), "little")

    def start(self) -> None:
        assert self.tell(NMT, bytes((START, 5))) == []
        assert self.unit.nmt_state == "OPERATIONAL"

    def frame(self) -> TactileFrame:
        """Send a SYNC and return the frame that comes."""
        assembler = FrameAssembler(FrameFormat.of(self.layout))
        frames = [
            frame
            for can_id, data in self.tell(SYNC)
            if can_id == TPDO1 and (frame := assembler.push(data, self.now_s)) is not None
        ]
        self.wait(0.02)
        [frame] = frames
        return frame


@pytest.fixture
def line() -> Line:
    """A unit of the paper's layout that has booted."""
    return Line()


def test_services_follow_the_nmt_state(line) -> None:
    upload = struct.pack("<BHB4x", 0x40, 0x1000, 0)
    assert line.tell(SYNC) == []
    assert len(line.tell(SDO_IN, upload)) == 1
    line.start()
    assert len(line.tell(SYNC, b"\x07")) == 59  # it may carry a counter
    assert len(line.tell(SDO_IN, upload)) == 1
    line.wait(0.02)
    line.tell(NMT, bytes((STOP, 5)))
    assert line.tell(SYNC) == []
    assert line.tell(SDO_IN, upload) == []
    line.unit.emergency(0x5000)
    assert line.take() == []
    assert line.skin.scans == 1


@pytest.mark.parametrize(
    "command", [b"", b"\x01", b"\x01\x06", b"\x81\x06", b"\x01\x05\x00", b"\x63\x05"]
)
def test_nmt_commands_that_are_not_meant_change_nothing(line, command) -> None:
    assert line.tell(NMT, command) == []
    line.wait(0.1)
    assert line.take() == []
    assert line.unit.nmt_state == "PRE-OPERATIONAL"


@pytest.mark.parametrize("command", [RESET_NODE, RESET_COMMUNICATION])
def test_a_reset_brings_one_boot_up_and_the_defaults_back(line, command) -> None:
    line.write(0x1017, 0, 50, 2)
    line.write(0x2141, 0, force_table(line.layout, FoamCalibration(255).force_n))
    line.start()
    line.frame()
    assert line.tell(NMT, bytes((command, 5))) == []
    assert line.tell(SYNC) == []
    line.take()
    line.wait(1.0)
    assert line.take() == [(HEARTBEAT, b"\x00")]
    assert line.unit.nmt_state == "PRE-OPERATIONAL"
    assert line.number(0x1017) == 0
    unchanged = command == RESET_COMMUNICATION
    assert (line.unit.scanner.forces._table_n is not None) is unchanged
    line.start()
    assert line.frame().counter == (1 if unchanged else 0)


def forces(line: Line, seconds: float) -> list[ForceMessage]:
    line.take()
    messages = []
    for _ in range(round(seconds / 0.001)):
        line.wait(0.001)
        messages += [
            decode_force_message(d, line.now_s) for can_id, d in line.take() if can_id == 0x285
        ]
    return messages


def test_a_force_message_waits_for_the_one_before_and_says_so(line) -> None:
    assert line.write(*(0x1801, 5), 2, 2) == 0
    line.start()
    line.message_s = 0.005
    messages = forces(line, 0.06)
    assert len(messages) == 10
    assert all(message.status & ScanStatus.OVERRUN for message in messages[1:])


def test_table_and_zero_need_a_right_checksum_and_can_be_read_back(line) -> None:
    table = force_table(line.layout, FoamCalibration(255).force_n)
    assert line.write(0x2141, 0, table) == 0
    assert line.read(0x2141) == table
    assert line.write(0x2141, 0, bytes((table[0] ^ 1,)) + table[1:]) == 0x0609_0030
    assert line.read(0x2141) == table


def test_an_emergency_is_sent_and_remembered(line) -> None:
    line.unit.emergency(0x5000)
    assert line.take() == [(EMCY, bytes.fromhex("00 50 01 00 00 00 00 00"))]
    line.unit.emergency(0x8110, register=0x10)
    assert line.take() == [(EMCY, bytes.fromhex("10 81 11 00 00 00 00 00"))]
    assert line.number(0x1003) == 2
    assert line.number(0x1003, 1) == 0x8110
    assert line.number(0x1003, 2) == 0x5000
    assert line.number(0x1001) == 0x11
    with pytest.raises(canopen.SdoAbortedError, match="08000024"):
        line.read(0x1003, 3)
    line.unit.emergency(0)
    assert line.take() == [(EMCY, bytes(8))]
    assert line.number(0x1001) == 0
    for code in range(0xFF10, 0xFF30):
        line.unit.emergency(code)
    line.take()
    assert line.number(0x1003) == 8
    assert line.write(0x1003, 0, 0, 1) == 0
    assert line.number(0x1003) == 0


def test_a_sync_during_a_burst_is_passed_over_and_told(line) -> None:
    line.start()
    assert len(line.tell(SYNC)) == 59
    line.wait(0.003)
    [(can_id, data)] = line.tell(SYNC)
    assert can_id == EMCY
    assert struct.unpack_from("<HB", data) == (EMCY_OVERRUN, 0x81)
    line.wait(0.001)
    assert line.tell(SYNC) == []
    line.wait(0.003)
    frame = line.frame()
    assert (frame.counter, frame.status) == (1, ScanStatus.OVERRUN)
    assert line.frame().status == 0


def test_a_burst_that_does_not_fit_the_window_is_cut_short_and_told(line) -> None:
    line.write(0x1007, 0, 3000, 4)
    line.start()
    heard = line.tell(SYNC)
    assert heard[0][0] == EMCY
    assert struct.unpack_from("<H", heard[0][1]) == (EMCY_WINDOW,)
    assert 20 < len(heard) - 1 < 30
    line.wait(0.02)
    line.write(0x1007, 0, 0, 4)
    assert line.frame().status == ScanStatus.OVERRUN


@pytest.mark.parametrize(
    ("index", "sub", "value", "size", "code"),
    [
        (0x1017, 0, 1, 4, 0x0607_0010),
        (0x1005, 0, 0, 4, 0x0609_0030),
        (0x1019, 0, 241, 1, 0x0609_0031),
        (0x1800, 1, 0x186, 4, 0x0609_0030),
        (0x1800, 1, 0x8000_0600, 4, 0x0609_0030),
        (0x1800, 2, 1, 1, 0x0609_0030),
    ],
)
def test_writes_that_are_not_allowed_are_refused(index, sub, value, size, code) -> None:
    assert Line().write(index, sub, value, size) == code


PAPER = BurstFormat(n_taxels=408, sample_bytes=1)
RAMP = np.arange(408) & 0xFF


@pytest.mark.parametrize(
    ("counts", "counter", "status", "last"),
    [
        (np.zeros(408, int), 0, 0, "3A 00 00 00 00 00 74 87"),
        (np.full(408, 255), 0xFFFF, 1, "FA FF FF FF FF 01 A4 36"),
        (RAMP, 0x1234, 0, "3A 96 97 34 12 00 31 1D"),
        (RAMP, 0x1235, 0, "7A 96 97 35 12 00 01 2A"),
    ],
)
def test_last_message_vectors(counts: np.ndarray, counter: int, status: int, last: str) -> None:
    assert PAPER.burst(counts, counter, status)[58] == bytes.fromhex(last)


LAYOUTS = [
    (paper_layout(), FoamCalibration(255)),
    (pinch_layout(), TableCalibration((500.0,), (1.0,), 4095)),
]


class Unit:
    """A unit whose pads are zeroed, and a way to press them."""

    def __init__(
        self, layout: TaxelLayout, calibration: Calibration, *, bad: tuple[int, ...] = ()
    ) -> None:
        self.layout = layout
        self.calibration = calibration
        self.n = sum(layout.pads[pad].n_taxels for pad in layout.gripping_pads)
        self.zero = np.full(self.n, 10.0)
        self.forces = PadForces(layout)
        self.forces.take_table(force_table(layout, calibration.force_n))
        dead = np.isin(np.arange(self.n), bad)
        self.forces.take_zero(encode_zero(0.016 * layout.adc_max, self.zero, dead, layout.adc_max))

    def press(self, taxel_n: dict[int, float], scans: int = 40) -> ForceMessage:
        force_n = np.zeros(self.layout.n_taxels)
        force_n[list(taxel_n)] = list(taxel_n.values())
        counts = np.rint(counts_of(self.calibration, force_n)[: self.n] + self.zero)
        for _ in range(scans):
            message = self.forces.message(counts.astype(np.uint16), ScanStatus(0))
        return message


@pytest.mark.parametrize(("layout", "calibration"), LAYOUTS, ids=["paper", "pinch"])
def test_the_sum_is_the_force_though_the_counts_are_not_linear(layout, calibration) -> None:
    unit = Unit(layout, calibration)
    columns = layout.pads[layout.gripping_pads[0]].columns
    n_first = layout.pads[layout.gripping_pads[0]].n_taxels
    middle = 5 * columns + 1
    pressed = {middle: 2.0, middle + 1: 1.0, n_first + middle: 2.5, n_first + middle + 1: 0.5}
    measured = unit.press(pressed, scans=20)
    assert measured.status == ScanStatus.ZEROED
    assert measured.force_n == pytest.approx((3.0, 3.0), abs=0.06)
    along = 5 - 0.5 * (layout.pads[layout.gripping_pads[0]].rows - 1)
    across = (1.0 * 4.5 + 2.0 * 1.5) / 6.0 - 0.5 * (columns - 1)
    assert measured.centre_taxels == pytest.approx((along, across), abs=0.08)


def test_a_touch_counts_within_a_few_scans_and_ends_with_the_load() -> None:
    unit = Unit(*LAYOUTS[0])
    touch = dict.fromkeys((20, 21, 24, 25, 28, 29), 0.1)
    seen_n = [unit.press(touch, scans=1).force_n[0] for _ in range(6)]
    assert (seen_n[0], seen_n[5]) == (0.0, pytest.approx(0.6, abs=0.05))
    assert unit.press({}, scans=30).force_n == pytest.approx((0.0, 0.0), abs=1e-3)
    assert unit.press({}, scans=1).centre_taxels is None


def test_a_touch_on_both_pads_counts_sooner_than_one_on_a_single_pad() -> None:
    one = dict.fromkeys((20, 21, 24, 25, 28, 29), 0.05)
    both = one | {(Unit(*LAYOUTS[0]).n // 2) + taxel: force_n for taxel, force_n in one.items()}

    def counts_after(touch: dict[int, float]) -> int:
        unit = Unit(*LAYOUTS[0])
        return next(n for n in range(1, 40) if unit.press(touch, scans=1).force_n[0] > 0.0)

    assert 1 < counts_after(both) < counts_after(one)


def test_noise_of_untouched_pads_is_no_force() -> None:
    unit, rng = Unit(*LAYOUTS[0]), np.random.default_rng(3)
    for _ in range(3000):
        noise = np.clip(np.abs(10.0 * rng.standard_normal(unit.n)), 1.0, 20.0) - 8.0
        counts = np.rint(unit.zero + noise).astype(np.uint16)
        assert unit.forces.message(counts, ScanStatus(0)).force_n == (0.0, 0.0)


def test_neighbours_stand_in_for_a_taxel_that_fails() -> None:
    whole, lame = Unit(*LAYOUTS[0]), Unit(*LAYOUTS[0], bad=(21,))
    touch = dict.fromkeys((16, 17, 18, 20, 21, 22, 24, 25, 26), 0.5)
    even_n = whole.press(touch).force_n[0]
    assert lame.press(touch | {21: 0.0}).force_n[0] == pytest.approx(even_n, rel=0.1)


def test_a_unit_without_table_or_zero_says_so_and_full_scale_too() -> None:
    layout, calibration = LAYOUTS[0]
    unit = Unit(layout, calibration)
    assert unit.press({4: 60.0}).status & ScanStatus.SATURATED
    assert not Unit(layout, calibration, bad=(4,)).press({4: 60.0}).status & ScanStatus.SATURATED
    unit.forces.reset()
    measured = unit.press({4: 1.0})
    assert (measured.status, measured.force_n) == (ScanStatus(0), (0.0, 0.0))


@pytest.mark.parametrize(
    ("knobs", "force_n", "centre"),
    [
        ({}, (2.0, 4.0), (1.0, 2.0)),
        ({"force_gain": 0.5, "force_offset_n": 1.0}, (2.0, 3.0), (1.0, 2.0)),
        ({"centre_shift_taxels": 3.0}, (2.0, 4.0), (4.0, 2.0)),
        ({"centres_off": True}, (2.0, 4.0), None),
    ],
)
def test_faults_change_force_and_centre_alone(knobs, force_n, centre) -> None:
    sound = ForceMessage(
        t_s=0.0, counter=3, status=ScanStatus.ZEROED, force_n=(2.0, 4.0), centre_taxels=(1.0, 2.0)
    )
    spoilt = ControlUnitFaults(**knobs).spoil(sound)
    assert spoilt == replace(sound, force_n=force_n, centre_taxels=centre)
