"""Recordings that were cut off or damaged become whole ones again."""

import json
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from cell.control.journal import Journal
from cell.data.recorder import Recorder
from cell.data.recording_reader import read_recording
from cell.data.recording_recovery import recover_recording
from cell.data.recording_schema import RECOVERED
from cell.errors import RecordingError
from cell.interfaces.cli.app import app
from tactile.source import TactileFrame
from tests.cell.conftest import plain_grasp


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """Forty grasps of twelve frames, in several chunks."""
    rng = np.random.default_rng(0)
    grasps = [
        plain_grasp(f"object {i}", counts=rng.integers(500, 4096, (12, 24))) for i in range(40)
    ]
    path = tmp_path / "r.mcap"
    with Recorder(path, time, pads=grasps[0].pads) as recorder:
        for number, grasp in enumerate(grasps):
            for i in range(grasp.n_frames):
                recorder.frame(
                    TactileFrame(
                        t_s=10.0 * number + float(grasp.t_s[i]),
                        counter=i,
                        status=0,
                        counts=grasp.counts[i],
                    )
                )
            Journal(recorder).note("note", f"grasp {number}")
            recorder.grasp(grasp)
    return path


def damage(path: Path, kind: str) -> None:
    data = bytearray(path.read_bytes())
    if kind == "cut":
        del data[len(data) // 2 :]
    else:
        data[len(data) // 2] ^= 0x10
    path.write_bytes(data)


@pytest.mark.parametrize("kind", ["cut", "bit"])
def test_what_is_whole_is_kept_and_what_is_lost_is_said(recording, kind) -> None:
    before = read_recording(recording)
    whole = recover_recording(recording, recording.with_name("copy.mcap"))
    assert (whole.lost_reason, whole.n_grasps) == ("", 40)
    assert RECOVERED not in read_recording(whole.recording).metadata
    damage(recording, kind)
    damaged = read_recording(recording)
    assert not damaged.complete
    assert len(damaged.grasps) < 40
    assert damaged.n_broken_grasps == (1 if kind == "bit" else 0)
    found = recover_recording(recording, recording.with_name("new.mcap"))
    after = read_recording(found.recording)
    assert after.complete
    assert after.n_broken_grasps == 0
    assert found.lost_reason == damaged.lost_reason
    assert found.lost_reason in after.metadata[RECOVERED]
    assert found.n_grasps == len(after.grasps) == len(damaged.grasps) > 0
    assert found.n_frames == len(after.frames) == len(damaged.frames)
    places = {int(number): i for i, number in enumerate(before.frames.number)}
    same = [places[int(number)] for number in after.frames.number]
    np.testing.assert_array_equal(after.frames.counts, before.frames.counts[same])
    labels = {grasp.label: grasp for grasp in before.grasps}
    for grasp in after.grasps:
        np.testing.assert_array_equal(grasp.counts, labels[grasp.label].counts)


def test_the_command_says_what_is_lost_and_never_overwrites(recording, tmp_path) -> None:
    damage(recording, "cut")
    report = tmp_path / "r.json"
    done = CliRunner().invoke(app, ["recover", str(recording), "--json", str(report)])
    assert done.exit_code == 0, done.output
    said: dict[str, Any] = json.loads(report.read_text())
    assert said["recording"] == str(tmp_path / "r-recovered.mcap")
    assert said["lost_reason"]
    assert read_recording(said["recording"]).complete
    with pytest.raises(RecordingError, match="never overwritten"):
        recover_recording(recording, said["recording"])
