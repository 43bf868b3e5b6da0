"""An independent witness: tshark decodes the CAN traffic of a whole job as CANopen."""

import shutil
import subprocess
from collections import Counter
from pathlib import Path

import pytest

from cell.build import build_cell
from cell.config import CellConfig
from cell.pose import Pose
from cell.sequence import GraspStep

TSHARK = shutil.which("tshark")


@pytest.mark.skipif(TSHARK is None, reason="tshark is not installed (Debian package tshark)")
def test_a_captured_grasp_is_canopen_to_tshark(tmp_path: Path) -> None:
    capture = tmp_path / "grasp.pcap"
    cell = build_cell(CellConfig(), capture=capture)
    cell.controller.start()
    cell.controller.present("ball")
    record = cell.controller.grasp(GraspStep(pose=Pose(), force_n=3.0))
    frames = cell.link.statistics.frames.complete
    cell.close()
    assert record.grasp.n_frames > 30

    def decode(*arguments: str) -> list[str]:
        done = subprocess.run(
            [str(TSHARK), "-r", str(capture), "-d", "can.subdissector,canopen", *arguments],
            capture_output=True,
            text=True,
            check=True,
            timeout=60,
        )
        return done.stdout.splitlines()

    assert decode("-Y", "_ws.malformed") == []
    kinds = Counter(line.split("CANopen ", 1)[1].split(":")[0] for line in decode())
    syncs = sum(n for kind, n in kinds.items() if kind.endswith("SYNC"))
    assert syncs in (frames, frames + 1)
    commands = [line for line in decode("-Y", "canopen.nmt_ctrl.cd") if "NMT" in line]
    assert any("Start remote node" in line for line in commands)
    samples = decode(
        "-Y", "canopen.cob_id == 0x185", "-T", "fields", "-e", "canopen.pdo.data.bytes"
    )
    assert len(samples) >= 59 * frames
