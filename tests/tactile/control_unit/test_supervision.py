"""Emergency texts and the parts of the supervision that the link's tests do not reach."""

import pytest

from tactile.control_unit.supervision import NodeSupervisor, emergency_text
from tactile.errors import BusErrorPassive


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
    supervisor = NodeSupervisor("the unit", heartbeat_s=0.1)
    supervisor.on_error_frame(0x04, bytes([0, 0x30]), 1.0)
    supervisor.on_error_frame(0x100, b"", 1.2)
    supervisor.check(2.0)
    supervisor.on_error_frame(0x04, bytes([0, 0x10]), 3.0)
    supervisor.on_error_frame(0x04, bytes([0, 0x10]), 3.4)
    supervisor.on_error_frame(0x04, b"", 3.4)
    with pytest.raises(BusErrorPassive, match=r"0\.50 s"):
        supervisor.check(3.5)
    assert supervisor.error_frames == 5
