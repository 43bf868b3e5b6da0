"""An independent witness: tshark decodes the CAN traffic of a whole job as CANopen."""

import shutil
import subprocess
from collections import Counter
from pathlib import Path

import pytest

from cell.learning.parallel import silent
from cell.runtime.main_job import teach_and_identify
from cell.runtime.plugin import TactileCellPlugin
from tests.cell.cells import small_config

TSHARK = shutil.which("tshark")
FINDINGS = ("_ws.malformed", "_ws.expert.severity >= 6291456")
"""Filters of tshark for malformed messages, and for warnings and errors."""


pytestmark = pytest.mark.skipif(
    TSHARK is None, reason="tshark is not installed (Debian package tshark)"
)


def decode(capture: Path, *arguments: str) -> list[str]:
    """Return what tshark prints of a capture whose CAN messages it takes for CANopen."""
    done = subprocess.run(
        [str(TSHARK), "-r", str(capture), "-d", "can.subdissector,canopen", *arguments],
        capture_output=True,
        text=True,
        check=True,
        timeout=100,
    )
    return done.stdout.splitlines()


def logged(t_s: float, can_id: int, data: bytes) -> str:
    """Return a message as a line of `candump -L`."""
    return f"({t_s:.6f}) can0 {can_id:03X}#{data.hex().upper()}\n"


@pytest.mark.long
def test_a_captured_sequence_is_canopen_to_tshark(tmp_path: Path) -> None:
    capture = tmp_path / "short.log"
    asked = logged(0.0, 0x605, bytes.fromhex("4018100100000000"))
    capture.write_text(asked + logged(0.001, 0x585, bytes.fromhex("431810")))
    for finding in FINDINGS:  # the second message is cut short
        assert len(decode(capture, "-Y", finding)) == 1
    capture = tmp_path / "sequence.log"
    config = small_config()
    with capture.open("w") as log:
        with TactileCellPlugin(config, start=False) as plugin:
            bus = plugin.cell.simulated.can_bus
            bus.capture.append(lambda *message: log.write(logged(*message)))
            plugin.connect()
            labels, n_grasps = ["ball", "box"], {"n_teach": 3, "n_trials": 1}
            options = n_grasps | {"folder": tmp_path, "progress": silent}
            teach_and_identify(plugin, config, labels=labels, **options)
            n_requests = plugin.cell.controller.hand.statistics.source.requests
        bus._link.clear()  # what is on its way goes out

    for finding in FINDINGS:
        assert decode(capture, "-Y", finding) == []
    columns = ("-e", "canopen.cob_id", "-e", "canopen.nmt_guard.state", "-e", "canopen.nmt_ctrl.cd")
    rows = [row.split("\t") for row in decode(capture, "-T", "fields", *columns)]
    kinds = Counter(int(cob_id, 16) for cob_id, *_ in rows)
    assert set(kinds) == {0x000, 0x080, 0x285, 0x385, 0x585, 0x605, 0x705}
    assert kinds[0x080] == n_requests
    assert kinds[0x585] == kinds[0x605] > 10
    commands = [int(command, 0) for _, _, command in rows if command]
    assert commands == [130, 1, 128]  # reset communication, start, pre-operational at the end
    states = [int(state, 0) for _, state, _ in rows if state]
    assert states[0] == 0
    assert set(states[states.index(5) :]) == {5}
