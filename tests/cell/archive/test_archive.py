"""An archive has each grasp once, as it was recorded, whatever is archived how often."""

import itertools
import json
import re
import runpy
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import duckdb
import fsspec
import numpy as np
import pytest
from fsspec.implementations.local import LocalFileSystem

from cell.archive.ingest import ingest, sources
from cell.archive.page import archive_report, confusion_table, lines
from cell.archive.questions import ask
from cell.archive.selection import Selection, parse_selection
from cell.archive.store import TABLE, Archive, grasp_key
from cell.errors import ArchiveError, CellError, ConfigError, ReportError
from cell.files import alone_in
from cell.learning.model import load_model
from cell.learning.parallel import silent
from cell.recording.dataset import read_dataset, write_dataset
from cell.recording.reader import recording_grasps
from cell.recording.recorder import Recorder
from cell.report.page import render_report
from recognition.drift.drift import day_effects
from recognition.grasp import COMMAND_COLUMNS, ZERO_COLUMNS, Grasp, GraspCommand, SelfZero
from recognition.recognizer import UNKNOWN
from tests.cell.archive.fleet import PADS, SIZES_MM, ramp, record, record_fleet
from tests.cell.cells import call
from tests.fuzz.harness import Clock, same_grasps

add = partial(ingest, progress=silent)
EXAMPLE = Path(__file__).parents[3] / "docs/examples/train_on_a_cluster.py"


@pytest.fixture(scope="session")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("fleet")
    record_fleet(folder, n_days=3)
    return folder


@pytest.fixture(scope="session")
def archived(fleet: Path, tmp_path_factory: pytest.TempPathFactory) -> str:
    target = str(tmp_path_factory.mktemp("archived") / "fleet")
    add(target, sources([fleet]))
    return target


def every(target: str) -> list[dict[str, Any]]:
    return sorted(
        (row for batch in Archive(target).batches(TABLE.names) for row in batch.to_pylist()),
        key=lambda row: row["key"],
    )


def test_work_that_is_done_twice_and_a_second_run_add_nothing(fleet, archived, tmp_path) -> None:
    def twice(work: Callable[[Any], Any], items: Any, /) -> Iterator[Any]:
        """Do each piece again, as after the death of a worker that had done it."""
        for item in items:
            work(item)
            yield work(item)

    target = str(tmp_path / "archive")
    done = add(target, sources([fleet]), mapper=twice)
    assert (done.n_files, done.n_grasps, done.n_before) == (6, 36, 0)
    (tmp_path / "linked").symlink_to(fleet)
    done = add(target, sources([tmp_path]))
    assert (done.n_files, done.n_there, done.n_grasps, done.left) == (0, 6, 0, {})
    assert every(target) == every(archived)
    assert len(every(target)) == 36


def test_a_row_leads_back_to_its_recording(archived) -> None:
    row = next(one for one in every(archived) if one["answer"])
    grasp = recording_grasps(row["recording"])[row["grasp"]]
    where = Selection(cells=frozenset({grasp.source.removeprefix("cell ")}))
    (stored,) = (g for g in Archive(archived).grasps(where) if g.start_ms == row["start_ms"])
    assert same_grasps([stored], [grasp], but=["label"])
    assert row["label"] == row["answer"]
    assert not row["taught"]
    assert dict(row["probabilities"]) == {"ball": 0.2, "box": 0.7, "pen": 0.1}
    assert (row["part_grasps"], row["of_part"], row["size_m"]) == (1, 0, 0.03)
    assert row["closing_current_a"] == pytest.approx(0.13)
    assert row["hold_current_a"] == pytest.approx(0.33)
    assert row["hold_force_n"] == pytest.approx(5.0)
    assert row["drift_gain"] == 0.9
    assert len(row["pad_load"]) == 2
    assert np.all(np.isfinite(row["features"]))


def test_a_data_set_comes_back_as_it_was(tmp_path) -> None:
    rng = np.random.default_rng(1)
    rich = {name: getattr(ramp("box", rng), name) for name in Grasp.__dataclass_fields__} | {
        "command": GraspCommand(**dict.fromkeys(COMMAND_COLUMNS, 0.25)),
        "zero": SelfZero(**dict.fromkeys(ZERO_COLUMNS, 0.03125)),
        "thickness_m": 0.02,
        "series": "second day",
        "source": "",
        "start_ms": 86_400_000,
    }
    bare = Grasp(pads=PADS, counts=np.zeros((1, PADS.n_taxels)), t_s=[0.0])
    write_dataset(tmp_path / "a.npz", [Grasp(**rich), bare])
    target = str(tmp_path / "archive [old] *")
    assert add(target, [tmp_path / "a.npz"], cell="press/3").n_grasps == 2
    before = sorted(read_dataset(tmp_path / "a.npz"), key=lambda grasp: grasp.start_ms)
    after = sorted(Archive(target).grasps(), key=lambda grasp: grasp.start_ms)
    assert same_grasps(before, after, but=["source"])
    assert [grasp.source for grasp in after] == ["cell press/3"] * 2
    assert {(row["cell"], row["day"]) for row in every(target)} == {
        ("press/3", "1970-01-01"),
        ("press/3", "1970-01-02"),
    }


def test_a_data_set_beside_its_recording_and_a_copy_add_nothing(fleet, tmp_path) -> None:
    recording = sources([fleet])[0]
    (tmp_path / "job").mkdir()
    shutil.copy(recording, tmp_path / "job" / "recording.mcap")
    shutil.copy(recording, tmp_path / "copy.mcap")
    taught = recording_grasps(recording)
    write_dataset(tmp_path / "job" / "parts.npz", [*taught, ramp("pen", np.random.default_rng(1))])
    done = add(str(tmp_path / "archive"), sources([tmp_path]))
    assert (done.n_files, done.n_there) == (2, 1)
    assert (done.n_grasps, done.n_before) == (7, 6)
    rows = every(str(tmp_path / "archive"))
    assert len({row["key"] for row in rows}) == 7
    # The rows of the recording have answers and servos.
    assert sum(row["recording"].endswith(".mcap") for row in rows) == 6


def test_what_is_torn_foreign_or_unfinished_is_named_and_left_for_later(fleet, tmp_path) -> None:
    whole = sources([fleet])[0]
    torn = tmp_path / "torn.mcap"
    torn.write_bytes(whole.read_bytes()[: whole.stat().st_size // 2])
    (tmp_path / "foreign.mcap").write_bytes(b"no recording")
    np.savez(tmp_path / "foreign.npz", a=np.arange(3))
    (tmp_path / "notes.txt").write_text("not looked at")
    np.savez(tmp_path / "model.npz", model=np.array("{}"))
    open_recording = Recorder(tmp_path / "open.mcap", Clock(), pads=PADS)
    target = str(tmp_path / "archive")
    done = add(target, sources([tmp_path]))
    assert done.n_files == 0
    left = {Path(path).name: why for path, why in done.left.items()}
    assert left.keys() == {"torn.mcap", "foreign.mcap", "foreign.npz", "open.mcap"}
    assert "not complete" in left["torn.mcap"]
    assert "is not a recording" in left["foreign.mcap"]
    assert "missing" in left["foreign.npz"]
    assert "still writes" in left["open.mcap"]
    open_recording.close()
    torn.write_bytes(whole.read_bytes())
    done = add(target, sources([tmp_path]))
    assert (done.n_files, done.n_grasps, len(done.left)) == (2, 6, 2)


@pytest.mark.slow
def test_a_kill_at_any_moment_gives_each_row_once_after_the_next_run(tmp_path, monkeypatch) -> None:
    """Of each step that changes the disk: a kill before it, and after it."""
    rng = np.random.default_rng(5)
    first, shared, last = (ramp("pen", rng, start_ms=n // 3 * 10**9) for n in (1, 2, 3))
    for name, grasps in {"a": (first, shared), "b": (shared, last, last)}.items():
        write_dataset(tmp_path / f"{name}.npz", grasps)
    add(str(tmp_path / "whole"), sources([tmp_path]))
    whole = every(str(tmp_path / "whole"))
    assert len(whole) == 3
    n_moments, kill_at = 0, -1

    def moment() -> None:
        nonlocal n_moments
        n_moments += 1
        if n_moments == kill_at:
            raise KeyboardInterrupt

    def stepping(name: str) -> None:
        step = getattr(LocalFileSystem, name)

        def counted(*given: Any, **named: Any) -> Any:
            if name == "open" and "rb" in (*given[2:], named.get("mode", "rb")):
                return step(*given, **named)
            moment()
            done = step(*given, **named)
            moment()
            return done

        monkeypatch.setattr(LocalFileSystem, name, counted)

    for name in ("makedirs", "mv", "pipe_file", "rm", "open"):
        stepping(name)
    for kill_at in itertools.count(1):
        target = str(tmp_path / f"killed {kill_at}")
        n_moments = 0
        try:
            add(target, sources([tmp_path]))
        except KeyboardInterrupt:  # no further one
            add(target, sources([tmp_path]))
        else:
            break
        assert every(target) == whole
        assert not Path(target, "_staged").exists()
    assert kill_at > 25


def test_an_object_store_is_an_archive_too(fleet, archived) -> None:
    target = "memory://fleet"
    add(target, sources([fleet])[:2])
    assert every(target) == [row for row in every(archived) if "run-00" in row["recording"]]
    assert len(list(Archive(target).grasps())) == 12
    fsspec.filesystem("memory").rm("/fleet", recursive=True)


def test_other_places_are_refused(tmp_path) -> None:
    with pytest.raises(ArchiveError, match=r"is not an archive; `tactile-cell archive"):
        Archive(str(tmp_path))
    (tmp_path / "_archive.json").write_text("[")
    with pytest.raises(ArchiveError, match="is damaged, it is not JSON"):
        Archive(str(tmp_path))
    with pytest.raises(ArchiveError, match="is not there"):
        sources([tmp_path / "nowhere"])
    with pytest.raises(ArchiveError, match="no recording"):
        sources([tmp_path])
    with pytest.raises(ArchiveError, match="check place and rights"):
        Archive("nothing://here", create=True)


def test_the_repair_of_a_damaged_file_loses_no_grasp(tmp_path) -> None:
    rng = np.random.default_rng(4)
    first, second, third = (ramp("pen", rng, start_ms=number) for number in range(3))
    for name, grasps in {"b": (first, second), "a": (second, third)}.items():
        write_dataset(tmp_path / f"{name}.npz", grasps)
    target = tmp_path / "archive"
    add(str(target), [tmp_path / "b.npz"])
    (damaged,) = target.glob("cell=*/*/*.parquet")
    add(str(target), [tmp_path / "a.npz"])
    keys = [row["key"] for row in every(str(target))]
    assert len(keys) == 3
    damaged.write_bytes(damaged.read_bytes()[:100])
    write_dataset(tmp_path / "c.npz", [first])
    done = add(str(target), [tmp_path / "c.npz"])
    assert done.n_files == 0
    with pytest.raises(ArchiveError) as read:
        every(str(target))
    for said in (str(read.value), *done.left.values()):
        assert f"{damaged} cannot be read" in said
        assert "remove it and _sources of the archive, and archive its recording" in said
    damaged.unlink()
    shutil.rmtree(target / "_sources")
    add(str(target), sources([tmp_path]))
    assert [row["key"] for row in every(str(target))] == keys


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"n_grasps": 2**40}, "does not fit an archive: .*1099511627776"),
        ({"cell": 50 * "ü"}, "makes a folder name of 305 bytes, at most 255 are possible"),
    ],
)
def test_a_file_that_does_not_fit_is_named_and_others_are_archived(tmp_path, changes, why) -> None:
    for name, values in {"a": changes, "b": {"cell": 40 * "ü"}}.items():
        grasps = [ramp("pen", np.random.default_rng(5), cell=values.get("cell", "press"))]
        record(tmp_path / f"{name}.mcap", grasps, answers=["pen"], **values)
    done = add(str(tmp_path / "archive"), sources([tmp_path]))
    assert (done.n_files, done.n_grasps, list(done.left)) == (1, 1, [str(tmp_path / "a.mcap")])
    assert re.search(why, done.left[str(tmp_path / "a.mcap")])
    (row,) = every(str(tmp_path / "archive"))
    assert row["cell"] == 40 * "ü"


def test_a_selection_reads_only_its_cells_days_and_objects(archived) -> None:
    chosen = parse_selection(["press 2"], "2027-01-05..2027-01-06", ["box"])
    grasps = list(Archive(archived).grasps(chosen))
    assert len(grasps) == 4
    assert all(chosen.fits(grasp) for grasp in grasps)
    assert parse_selection([], "2027-01-05", []) == Selection(
        first_day="2027-01-05", last_day="2027-01-05"
    )
    assert len(list(Archive(archived).grasps(Selection(first_day="2027-01-07")))) == 0
    with pytest.raises(ConfigError, match=r"2027-01-01\.\."):
        parse_selection([], "January", [])
    with pytest.raises(ConfigError, match="--days is ''"):
        parse_selection([], "", [])
    with pytest.raises(ConfigError, match="begins after its end"):
        parse_selection([], "2027-01-06..2027-01-05", [])


def test_some_grasps_of_each_object_are_the_same_each_time(archived) -> None:
    archive = Archive(archived)
    keys = {
        label: sorted(row["key"] for row in every(archived) if row["label"] == label)
        for label in SIZES_MM
    }
    some = sorted(grasp_key(grasp) for grasp in archive.grasps(most=5))
    assert some == sorted(key for of_label in keys.values() for key in of_label[:5])
    assert len(list(archive.grasps(most=100))) == 36


def test_duckdb_reads_the_table(archived) -> None:
    rows = duckdb.sql(
        f"select cell, count(*), any_value(counts[30][1]), any_value(zero.opening_m) "
        f"from read_parquet('{archived}/cell=*/*/*.parquet', hive_partitioning=true) "
        "group by cell order by cell"
    ).fetchall()
    assert [row[:2] for row in rows] == [("press 1", 18), ("press 2", 18)]
    assert all(row[2] > 0 for row in rows)


@pytest.mark.long
def test_the_example_trains_and_evaluates_on_a_cluster_of_two_workers(
    fleet, archived, tmp_path, capsys
) -> None:
    from distributed import LocalCluster

    model, target = tmp_path / "m.npz", str(tmp_path / "archive")
    workers = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": None}
    with LocalCluster(processes=False, protocol="tcp", **workers) as cluster:
        runpy.run_path(str(EXAMPLE))["main"](cluster.scheduler_address, fleet, target, model)
    out = capsys.readouterr().out
    assert "36 grasps of 6 files, 0 files left" in out
    assert re.search(r"force_ramp: [0-9.]+% of the grasps of new days named rightly", out)
    assert every(target) == every(archived)
    assert load_model(model).labels == tuple(SIZES_MM)


# -- The questions to an archive are answered by its recordings ------------------------------------


@pytest.fixture(scope="session")
def aged(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Return the archive of ten days of two cells, of which one ages."""
    folder = tmp_path_factory.mktemp("aged")
    record_fleet(folder / "recordings", n_days=10)
    target = str(folder / "archive")
    ingest(target, sources([folder / "recordings"]), progress=silent)
    return target


def test_each_question_names_the_cell_that_it_concerns(aged: str) -> None:
    answers = ask(aged)
    assert answers.n_grasps == 120
    assert {trend.cell for trend in answers.counted("drift")} == {"press 2"}
    ageing = {(trend.cell, trend.signal) for trend in answers.counted("ageing")}
    assert ("press 2", "pad 1") in ageing
    assert ageing <= {("press 2", "pad 1"), ("press 2", "pad 0 against pad 1")}
    assert [trend.cell for trend in answers.counted("friction")] == ["press 2"]
    json.dumps(answers.as_json())
    trends = {(trend.cell, trend.signal): trend for trend in answers.trends}
    opening = trends["press 2", "opening"]
    assert opening.change == pytest.approx(0.3 * 9, abs=0.2)
    assert opening.interval[0] < opening.change < opening.interval[1]
    assert trends["press 2", "pad 1"].change == pytest.approx(9 * np.log(0.95), abs=0.1)
    assert trends["press 2", "friction"].change == pytest.approx(9 * np.log(1.04), abs=1e-3)
    assert not any(trend.counts for (cell, _), trend in trends.items() if cell == "press 1")
    # A confusion has its days and cells.
    (pair,) = answers.confusions
    assert (pair.label, pair.answer, pair.n, pair.n_parts) == ("box", "ball", 5, 20)
    assert (pair.cells, pair.first, pair.last) == ({"press 2": 5}, "2027-01-09", "2027-01-13")
    assert confusion_table(answers).text == "55 of 60 right, 5 wrong"
    # The objects that need grasps come first.
    first, *others = answers.objects
    assert (first.label, first.reasons) == ("box", ("named rightly 15 of 20 times",))
    assert all(not other.reasons for other in others)
    few = ask(aged, Selection(last_day="2027-01-04")).objects
    assert all("4 grasps, 10 are needed" in need.reasons for need in few)


def test_day_effects_are_found_beside_objects_that_are_not_grasped_each_day() -> None:
    rng = np.random.default_rng(1)
    days, objects = rng.normal(size=6), rng.normal(0.0, 10.0, 4)
    n = rng.integers(0, 4, (6, 4)).astype(float)
    n[:, 0] = 1.0
    effects = day_effects(days[:, None] + objects, n)
    np.testing.assert_allclose(effects, days - days.mean(), atol=1e-6)


def test_the_page_has_the_answers_and_no_markup_of_labels(aged: str) -> None:
    answers = ask(aged)
    cells = {**answers.cells, "<script>": ()}
    page = render_report(archive_report(replace(answers, cells=cells), "<script>"))
    assert "<script>" not in page
    for line in lines(answers):
        assert line.removeprefix("needs more grasps: box: ") in page
    assert page.count('class="plot"') == len({one.signal for one in answers.trends})


def test_unknown_is_the_right_answer_to_an_object_that_was_never_taught(tmp_path: Path) -> None:
    target, rng = str(tmp_path / "archive"), np.random.default_rng(4)
    nuts = [replace(ramp("ball", rng, start_ms=i), label="nut") for i in range(3)]
    record(tmp_path / "recording.mcap", nuts, answers=[UNKNOWN, UNKNOWN, "ball"])
    add(target, sources([tmp_path]))
    answers = ask(target)
    assert [(need.label, need.n_right, need.n_parts) for need in answers.objects] == [("nut", 2, 3)]
    assert [(one.label, one.answer, one.n) for one in answers.confusions] == [("nut", "ball", 1)]
    table = confusion_table(answers)
    assert table is not None
    assert table.text == "2 of 3 right, 1 wrong"


def test_a_data_set_names_the_grasps_of_a_recording_and_one_program_adds(tmp_path: Path) -> None:
    target, rng = str(tmp_path / "archive"), np.random.default_rng(5)
    record(tmp_path / "recording.mcap", [replace(ramp("ball", rng), label="")], answers=[UNKNOWN])
    (recorded,) = recording_grasps(tmp_path / "recording.mcap")
    write_dataset(tmp_path / "named.npz", [replace(recorded, label="nut", series="monday")])
    add(target, sources([tmp_path]))
    rows = Archive(target).table(["label", "series", "answer"]).to_pylist()
    assert rows == [{"label": "nut", "series": "monday", "answer": UNKNOWN}]
    for address in (target, f"file://{target}"):
        with (
            alone_in(Path(target), CellError("x")),
            pytest.raises(ArchiveError, match="another program adds"),
        ):
            add(address, sources([tmp_path]))
    # Where no lock is possible, rows that another program has removed are missed, not counted.
    archive, staged = Archive(target), Archive(target).stage("5" * 64, [])
    archive.clear_staged()
    with pytest.raises(ArchiveError, match="another program adds"):
        archive.add("5" * 64, "x.npz", staged)
    assert not archive.has_source("5" * 64)


def test_an_archive_without_answers_says_so(tmp_path: Path) -> None:
    rng, untaught = np.random.default_rng(2), str(tmp_path / "untaught")
    write_dataset(tmp_path / "a.npz", [ramp("ball", rng, start_ms=i) for i in range(3)])
    add(untaught, [tmp_path / "a.npz"])
    answers = ask(untaught)
    assert confusion_table(answers) is None
    assert lines(answers)[0].startswith("No answer about confusions")
    for line, question in zip(lines(answers)[1:], ("drift", "ageing", "friction"), strict=False):
        assert line.startswith(f"No answer about {question}: fewer than 3 days of the same objects")
    render_report(archive_report(answers, untaught))


def test_commands_work_on_a_selection(aged: str, tmp_path: Path) -> None:
    out = call("archive", "report", aged, "-o", tmp_path / "a.html", "--cell", "press 1")
    assert "press 2" not in out
    boxes = ("--cell", "press 1", "--object", "box")
    for kind, start in ((".png", b"\x89PNG"), (".svg", b"<?xml")):
        picture = tmp_path / f"a{kind}"
        assert "box, press 1" in call("recording", "plot", 0, aged, "-o", picture, *boxes)
        assert picture.read_bytes().startswith(start)
    with pytest.raises(ReportError, match=r"\.png or \.svg"):
        call("recording", "plot", 0, aged, "-o", tmp_path / "a.txt")


def test_training_learns_the_spread(aged: str, tmp_path: Path) -> None:
    result = tmp_path / "a.json"
    call("model", "train", aged, "-o", tmp_path / "a.npz", "--object", "ball", "--json", result)
    assert 0.0 < json.loads(result.read_text())["spread"]["offset_sd_mm"] < 3.0


@pytest.mark.long
@pytest.mark.timeout(300)
def test_evaluation_leaves_days_and_cells_out(aged: str) -> None:
    few = ["--recognizer", "level_check", "--fuse", "1"]
    out = call("model", "evaluate", aged, "--split", "cells", *few)
    assert "cells: 60 grasps to train, 120 to test, 3 objects" in out
    with pytest.raises(CellError, match="none can be left out"):
        call("model", "evaluate", aged, "--split", "cells", "--cell", "press 1", *few)
    with pytest.raises(CellError, match="no labelled grasp"):
        call("model", "evaluate", aged, "--object", "nothing", *few)
