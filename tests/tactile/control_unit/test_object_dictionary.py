"""The EDS: valid by an independent checker, loads in canopen, agrees with the constants."""

import subprocess
import sys
from pathlib import Path

import canopen
import pytest

from tactile.control_unit import object_dictionary as od
from tactile.frames.codec import FrameFormat
from tactile.layout import paper_layout


@pytest.fixture(scope="module")
def dictionary() -> canopen.ObjectDictionary:
    return od.of_node(5)


def test_dcfchk_finds_nothing() -> None:
    checker = Path(sys.executable).with_name("dcfchk")
    done = subprocess.run(
        [checker, "-n", "5", od.EDS_PATH], capture_output=True, text=True, check=False, timeout=30
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_every_tpdo_maps_64_bits(dictionary: canopen.ObjectDictionary) -> None:
    for index, known in ((0x1A00, od.TPDO1_ENTRIES), (0x1A01, od.TPDO2_ENTRIES)):
        entries = [dictionary[index][sub].default for sub in dictionary[index] if sub]
        assert tuple(entries) == known
        assert sum(entry & 0xFF for entry in entries) == 64
        for entry in entries:
            variable = dictionary[entry >> 16][entry >> 8 & 0xFF]
            assert variable.pdo_mappable
            assert len(variable) == entry & 0xFF


def test_cob_ids_follow_the_node_id(dictionary: canopen.ObjectDictionary) -> None:
    assert dictionary[od.TPDO1_PARAMETER][1].default == 0x185
    assert dictionary[od.EMCY_COB_ID].default == 0x85


def test_defaults_are_the_papers_layout(dictionary: canopen.ObjectDictionary) -> None:
    layout = paper_layout()
    frame_format = FrameFormat.of(layout)
    found = {
        (index, sub): dictionary[index][sub].default
        for index in (od.IDENTITY, od.LAYOUT, od.FORMAT)
        for sub in (1, 2, 3, 4)
    }
    assert found == {
        (od.IDENTITY, od.IDENTITY_VENDOR): od.VENDOR_ID,
        (od.IDENTITY, od.IDENTITY_PRODUCT): od.PRODUCT_CODE,
        (od.IDENTITY, od.IDENTITY_REVISION): od.REVISION,
        (od.IDENTITY, od.IDENTITY_SERIAL): 1,
        (od.LAYOUT, od.LAYOUT_PADS): layout.n_pads,
        (od.LAYOUT, od.LAYOUT_TAXELS): layout.n_taxels,
        (od.LAYOUT, od.LAYOUT_HASH): layout.layout_hash,
        (od.LAYOUT, od.LAYOUT_ADC_MAX): layout.adc_max,
        (od.FORMAT, od.FORMAT_SAMPLE_BITS): layout.sample_bits,
        (od.FORMAT, od.FORMAT_SAMPLE_BYTES): layout.sample_bytes,
        (od.FORMAT, od.FORMAT_MESSAGES): frame_format.n_messages,
        (od.FORMAT, od.FORMAT_HEADER_BYTES): frame_format.header_bytes,
    }


def test_every_index_constant_is_in_the_dictionary(dictionary: canopen.ObjectDictionary) -> None:
    indices = {
        value
        for name, value in vars(od).items()
        if name.isupper() and isinstance(value, int) and 0x1000 <= value <= 0x2FFF
    }
    assert len(indices) > 20
    assert indices <= set(dictionary)
