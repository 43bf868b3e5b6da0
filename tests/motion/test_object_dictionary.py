"""The EDS of a drive: valid by an independent checker, and in agreement with the constants."""

import subprocess
import sys
from pathlib import Path

import pytest
from canopen.profiles.p402 import State402

from motion import object_dictionary as od
from motion.object_dictionary import Control


def test_dcfchk_finds_nothing() -> None:
    checker = Path(sys.executable).with_name("dcfchk")
    done = subprocess.run(
        [checker, "-n", "11", od.EDS_PATH], capture_output=True, text=True, check=False, timeout=30
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_states_and_controlwords_are_those_of_canopen() -> None:
    for name, (mask, bits) in State402.SW_MASK.items():
        # Whatever the other bits are, among them "remote" and those of the mode.
        assert od.state_of(bits | ~mask & 0xFFFF) == name
    assert od.state_of(1) == "UNKNOWN"
    assert State402.CW_OPERATION_ENABLED == Control.ENABLE_OPERATION
    assert State402.CW_SHUTDOWN == Control.SHUTDOWN
    assert State402.CW_SWITCH_ON == Control.SWITCH_ON
    assert State402.CW_QUICK_STOP == Control.QUICK_STOP
    assert State402.CW_SWITCH_ON_DISABLED == Control.FAULT_RESET


@pytest.mark.parametrize(
    ("code", "text"),
    [
        (0x8611, "error 8611h: following error: the axis does not follow its set-point"),
        (0x2342, "error 2342h: current"),
        (0xFF07, "error FF07h: device specific"),
        (0x7305, "error 7305h: the encoder failed"),
    ],
)
def test_error_codes_have_words(code: int, text: str) -> None:
    assert od.error_code_text(code) == text
