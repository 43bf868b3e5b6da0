"""The report of a recording: whole, old, cut or spoiled."""

import json
import shutil
from dataclasses import replace
from typing import Any

import pytest

from cell.data.recorder import Recorder
from cell.data.recording_reader import Recording, read_recording
from cell.errors import RecordingError
from cell.report.page import render_report
from cell.report.recorded import recorded_report
from tests.cell.conftest import plain_pads
from tests.fuzz.harness import Clock


@pytest.fixture(scope="module")
def recording(taught: Any) -> Recording:
    """Five grasps of ball, five of box, then one identification of each."""
    return read_recording(taught.result.recording)


def with_config(recording: Recording, text: str) -> Recording:
    return replace(recording, metadata=recording.metadata | {"config": text})


@pytest.mark.slow
def test_figures_tables_and_files_of_a_run(recording, taught) -> None:
    data = recorded_report(recording)
    assert "10 grasps taught, 2 identifications" in data.subtitle
    assert "XM430-W350 (id 1)" in dict(data.facts)["Servos"]
    assert data.files == tuple(
        (name, str(getattr(taught.result, key)))
        for name, key in (("Recording", "recording"), ("Data set", "dataset"), ("Model", "model"))
    )
    assert "Simulated cell" in data.notes[-1]
    assert [group.title for group in data.health] == [
        "Tactile frames", "Servo bus", "Force loop"
    ]  # fmt: skip
    assert [one.caption for one in data.key_figures] == [
        *("right", "right with one grasp", "right by the paper's method", "grasps until sure")
    ]
    # The tables are those that the job counts and prints.
    for shown, counted in zip(data.confusions, taught.result.scores.values(), strict=True):
        assert (shown.name, shown.labels) == (counted.name, counted.labels)
        assert shown.counts.tolist() == counted.counts.tolist()
    for one, trial in zip(data.sequences, taught.result.trials, strict=True):
        assert (one.presented, one.label) == (trial.presented, trial.label)
        assert one.n_grasps == len(one.posteriors) == len(trial.records)
        assert str(one.shape) == str(trial.shape)
        first = trial.records[0]
        assert one.notes[0] == f"{first.reached}; {first.step.force_n:.1f} N"


def test_the_papers_method_as_recogniser_of_the_cell_has_one_table(recording) -> None:
    config = json.loads(recording.metadata["config"])
    config["recognition"]["recognizer"] = "level_check"
    data = recorded_report(with_config(recording, json.dumps(config)))
    assert [one.caption for one in data.key_figures] == [
        *("right", "right with one grasp", "grasps until sure")
    ]


@pytest.mark.slow
def test_a_recording_without_optional_values_shows_the_others(recording) -> None:
    def without(rows: Any, *names: str) -> Any:
        return tuple({k: v for k, v in row.items() if k not in names} for row in rows)

    few = replace(
        recording,
        results=without(recording.results, "held", "grasp_answers"),
        statistics=without(recording.statistics, "tactile", "servo_bus"),
    )
    data = recorded_report(few)
    assert data.facts == recorded_report(recording).facts
    assert data.confusions == ()
    assert [group.title for group in data.health] == ["Force loop"]
    assert data.key_figures[0].value == "2 of 2"
    assert [(one.name, one.presented, one.posteriors) for one in data.sequences] == [
        ("ball", "", ()),
        ("box", "", ()),
    ]
    page = render_report(data)
    assert page.count('class="card sequence named"') == 2
    assert '<section id="result">' not in page
    strange = recorded_report(with_config(recording, '{"unknown": 1}'))
    assert strange.facts == (("Sensor", "408 taxels on 10 pads"),)
    assert "config in the recording is not valid" in strange.notes[-1]


@pytest.mark.slow
def test_a_recording_that_was_cut_says_so_and_an_empty_one_is_refused(recording, tmp_path) -> None:
    cut = tmp_path / "cut.mcap"
    shutil.copyfile(recording.path, cut)
    with cut.open("r+b") as file:
        file.truncate(cut.stat().st_size // 2)
    data = recorded_report(read_recording(cut))
    assert data.notes[0].startswith("The recording is not complete: ")
    assert [one.caption for one in data.key_figures] == ["grasps taught"]
    assert '<section id="sequences">' not in render_report(data)
    Recorder(tmp_path / "empty.mcap", Clock(), pads=plain_pads((4, 3), (4, 3))).close()
    with pytest.raises(RecordingError, match="no whole grasp and no answer"):
        recorded_report(read_recording(tmp_path / "empty.mcap"))


@pytest.mark.parametrize(
    "spoil",
    [
        {"poses": ({"t_s": 1.0, "x_m": "far"},)},
        {"events": ({"t_s": "soon", "kind": "place", "text": "a at b"},)},
        {"results": ({"t_s": 1.0, "label": "ball", "labels": ["ball"], "n_grasps": 1},)},
        {"statistics": ({"t_s": 1.0, "cycles": None},)},
    ],
)
def test_values_that_no_cell_has_are_refused(recording, spoil) -> None:
    with pytest.raises(RecordingError, match="a message has impossible values"):
        recorded_report(replace(recording, **spoil))
