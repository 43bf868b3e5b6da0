"""The EDS by an independent checker, the load of the bus, texts of emergencies."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from simulator.can.wire import mean_bits
from tactile.control_unit import object_dictionary as od
from tactile.control_unit.settings import (
    LinkSettings,
    bus_load,
    least_sync_period_s,
    message_bits,
)
from tactile.control_unit.watch import NodeWatch, emergency_text
from tactile.errors import BusErrorPassive
from tactile.frames.codec import FrameFormat
from tactile.layout import paper_layout


def test_dcfchk_finds_nothing() -> None:
    checker = Path(sys.executable).with_name("dcfchk")
    done = subprocess.run(
        [checker, "-n", "5", od.EDS_PATH], capture_output=True, text=True, check=False, timeout=30
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_the_defaults_of_the_eds_are_those_of_the_papers_layout() -> None:
    dictionary, layout = od.of_node(5), paper_layout()
    form = FrameFormat.of(layout)
    found = [
        [dictionary[index][sub].default for sub in (1, 2, 3, 4)]
        for index in (od.IDENTITY, od.LAYOUT, od.FORMAT)
    ]
    assert found == [
        [od.VENDOR_ID, od.PRODUCT_CODE, od.REVISION, 1],
        [layout.n_pads, layout.n_taxels, layout.layout_hash, layout.adc_max],
        [layout.sample_bits, layout.sample_bytes, form.n_messages, form.header_bytes],
    ]
    assert dictionary[od.EMCY_COB_ID].default == 0x85


QUIET = LinkSettings(force_period_s=0.0, heartbeat_s=10.0)


@pytest.mark.parametrize(("n_bytes", "bits"), [(0, 55), (4, 95), (8, 135)])
def test_a_message_has_the_bits_of_the_standard_at_most(n_bytes: int, bits: int) -> None:
    assert message_bits(n_bytes) == bits
    assert mean_bits(bytes(n_bytes)) <= bits


@pytest.mark.parametrize(
    ("period_s", "bitrate", "share"),
    [(0.01, 1_000_000, 0.80), (0.02, 1_000_000, 0.40), (0.02, 500_000, 0.80)],
)
def test_the_frames_of_408_taxels_load_the_bus(period_s: float, bitrate: int, share: float) -> None:
    settings = replace(QUIET, sync_period_s=period_s)
    assert bus_load(paper_layout(), settings, bitrate) == pytest.approx(share, abs=0.005)


def test_force_messages_alone_may_be_too_many() -> None:
    settings = LinkSettings(force_period_s=0.001)
    assert least_sync_period_s(paper_layout(), settings, 125_000) == float("inf")


@pytest.mark.parametrize(
    ("code", "text"),
    [
        (0x0000, "no error"),
        (0x8110, "CAN overrun, messages lost"),
        (0x8130, "heartbeat or life guard error"),
        (0x8199, "monitoring"),
        (0x4212, "temperature"),
        (0x4312, "temperature"),
        (0xFF01, "a burst was cut short, it does not fit into the synchronous window"),
        (0xFF77, "device specific"),
        (0xAB00, "unknown code"),
    ],
)
def test_texts(code: int, text: str) -> None:
    assert emergency_text(code) == text


def test_restart_of_the_controller_ends_error_passive() -> None:
    watch = NodeWatch("the unit", LinkSettings())
    watch.on_error_frame(0x04, bytes([0, 0x30]), 1.0)
    watch.on_error_frame(0x100, b"", 1.2)
    watch.check(2.0, 0)
    watch.on_error_frame(0x04, bytes([0, 0x10]), 3.0)
    watch.on_error_frame(0x04, bytes([0, 0x10]), 3.4)
    watch.on_error_frame(0x04, b"", 3.4)
    with pytest.raises(BusErrorPassive, match=r"0\.50 s"):
        watch.check(3.5, 0)
    assert watch.error_frames == 5
