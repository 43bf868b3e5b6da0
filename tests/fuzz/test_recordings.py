"""Bad recordings: damaged MCAP files."""

import functools
import tempfile
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np

from cell.control.journal import Journal
from cell.errors import RecordingError
from cell.recording.reader import Recording, read_recording, recover_recording
from cell.recording.recorder import Recorder
from tactile.source import TactileFrame
from tests.fuzz.harness import Clock, bad_input, damages, good_grasps, same_grasps, spoilt
from tests.values import make_cycle


@functools.cache
def good() -> tuple[bytes, Recording]:
    """Return the bytes of a recording of two short grasps, and what is read of it."""
    clock = Clock()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "good.mcap"
        with closing(Recorder(path, clock, pads=good_grasps()[0].pads)) as recorder:
            for grasp in good_grasps()[:2]:
                times_s = clock.now_s + 0.03 * np.arange(1, 1 + len(grasp.counts))
                for i, clock.now_s in enumerate(times_s.tolist()):
                    recorder.frame(
                        TactileFrame(t_s=clock.now_s, counter=i, status=0, counts=grasp.counts[i])
                    )
                    recorder.cycle(make_cycle(clock.now_s))
                recorder.grasp(replace(grasp, t_s=times_s - times_s[0]))
            Journal(recorder).note("state", "COMPLETE")
        data, recording = path.read_bytes(), read_recording(path)
    assert (recording.complete, len(recording.grasps)) == (True, 2)
    return data, recording


def same(ours: Recording, other: Recording) -> bool:
    return (
        np.array_equal(ours.frames.counts, other.frames.counts)
        and np.array_equal(ours.frames.t_s, other.frames.t_s)
        and np.array_equal(ours.cycles.setpoint_n, other.cycles.setpoint_n)
        and ours.cycles.phase == other.cycles.phase
        and ours.events == other.events
        and ours.metadata == other.metadata
        and same_grasps(ours.grasps, other.grasps)
    )


@bad_input(harm=damages(), sound={"harm": []}, examples=100)
def test_a_damaged_recording_is_refused_unchanged_or_salvaged(tmp_path, harm):
    data, right = good()
    path, recovered = tmp_path / "x.mcap", tmp_path / "recovered.mcap"
    path.write_bytes(spoilt(data, harm))
    try:
        recording = read_recording(path)
    except RecordingError:
        return "refused"
    if recording.complete:
        assert same(recording, right)
        return "unchanged"
    assert len(recording.grasps) <= len(right.grasps)
    for grasp in recording.grasps:
        assert any(same_grasps([grasp], [other]) for other in right.grasps)
    recovered.unlink(missing_ok=True)
    try:
        recover_recording(path, recovered)
    except RecordingError:
        return "nothing to salvage"
    whole = read_recording(recovered)
    assert whole.complete
    assert same_grasps(whole.grasps, recording.grasps)
    return "salvaged"
