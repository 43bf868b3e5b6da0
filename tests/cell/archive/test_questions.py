"""The questions to an archive are answered by its recordings."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cell.archive.page import confusion_table, lines, write_page
from cell.archive.questions import ask
from cell.archive.selection import Selection
from cell.errors import CellError, ReportError
from cell.report.pictures import confusion_figure, grasp_figure, write_picture
from recognition.statistics.day_effects import day_effects
from tests.cell.archive.conftest import Fleet
from tests.cell.archive.fleet import ramp
from tests.cell.conftest import call


@pytest.mark.slow
def test_each_question_names_the_cell_that_it_concerns(aged: Fleet) -> None:
    found = ask(aged.archive)
    assert found.n_grasps == 120
    values = found.as_json()
    assert values["drifting_cells"] == ["press 2"]
    assert ("press 2", "pad 1") in values["ageing_pads"]
    assert all(cell == "press 2" for cell, _ in values["ageing_pads"])
    assert "pad 0" not in {signal for _, signal in values["ageing_pads"]}
    assert values["growing_friction"] == ["press 2"]
    json.dumps(values)


@pytest.mark.slow
def test_a_trend_has_the_size_that_was_made(aged: Fleet) -> None:
    trends = {(one.cell, one.signal): one for one in ask(aged.archive).trends}
    opening = trends["press 2", "opening"]
    assert opening.change == pytest.approx(0.3 * 9, abs=0.2)
    assert opening.interval[0] < opening.change < opening.interval[1]
    assert trends["press 2", "pad 1"].change == pytest.approx(9 * np.log(0.95), abs=0.1)
    assert trends["press 2", "friction"].change == pytest.approx(9 * np.log(1.04), abs=1e-3)
    assert trends["press 2", "friction"].since == "2027-01-06"
    assert not any(one.found for (cell, _), one in trends.items() if cell == "press 1")


def test_a_confusion_has_the_day_on_which_it_began(aged: Fleet) -> None:
    (one,) = ask(aged.archive).confusions
    assert (one.label, one.answer, one.n, one.n_parts) == ("box", "ball", 5, 20)
    assert one.cells == {"press 2": 5}
    assert (one.first, one.last) == ("2027-01-09", "2027-01-13")
    of_cell = ask(aged.archive, Selection(cells=frozenset({"press 2"}))).confusions[0]
    assert of_cell.since == "2027-01-09"
    table = confusion_table(ask(aged.archive))
    assert table.text == "55 of 60 right, 5 wrong"


def test_the_objects_that_need_grasps_come_first(aged: Fleet) -> None:
    first, *others = ask(aged.archive).objects
    assert (first.label, first.reasons) == ("box", ("named rightly 15 of 20 times",))
    assert all(not one.reasons for one in others)
    few = ask(aged.archive, Selection(last_day="2027-01-04")).objects
    assert all("4 grasps, 10 are needed" in one.reasons for one in few)


def test_day_effects_are_found_beside_objects_that_are_not_grasped_each_day() -> None:
    rng = np.random.default_rng(1)
    days, objects = rng.normal(size=6), rng.normal(0.0, 10.0, 4)
    n = rng.integers(0, 4, (6, 4)).astype(float)
    n[:, 0] = 1.0
    found = day_effects(days[:, None] + objects, n)
    np.testing.assert_allclose(found, days - days.mean(), atol=1e-6)


@pytest.mark.slow
def test_the_page_has_the_answers_and_no_markup_of_labels(aged: Fleet, tmp_path: Path) -> None:
    answers = ask(aged.archive)
    cells = {**answers.cells, "<script>": ()}
    write_page(tmp_path / "a.html", replace(answers, cells=cells), "<script>")
    page = (tmp_path / "a.html").read_text()
    assert "<script>" not in page
    for line in lines(answers):
        assert line.removeprefix("needs more grasps: box: ") in page
    assert page.count('class="plot"') == len({one.signal for one in answers.trends})


def test_an_archive_without_answers_says_so(tmp_path: Path, untaught: str) -> None:
    answers = ask(untaught)
    assert confusion_table(answers) is None
    assert lines(answers)[0] == "no object was confused with another one"
    for line, question in zip(lines(answers)[1:], ("drift", "ageing", "friction"), strict=False):
        assert line.startswith(f"No answer about {question}: fewer than 3 days of the same objects")
    write_page(tmp_path / "a.html", answers, untaught)
    with pytest.raises(CellError, match="evaluate"):
        call("plot", "confusion", untaught, "-o", tmp_path / "a.png")


@pytest.mark.slow
@pytest.mark.parametrize("kind", [".png", ".svg"])
def test_pictures_are_written(aged: Fleet, tmp_path: Path, kind: str) -> None:
    table = confusion_table(ask(aged.archive))
    write_picture(tmp_path / f"a{kind}", confusion_figure(table))
    write_picture(tmp_path / f"b{kind}", grasp_figure(ramp("ball", np.random.default_rng(1)), "$"))
    start = {".png": b"\x89PNG", ".svg": b"<?xml"}[kind]
    assert all((tmp_path / f"{name}{kind}").read_bytes().startswith(start) for name in "ab")


def test_a_picture_of_another_kind_is_refused(tmp_path: Path) -> None:
    figure = grasp_figure(ramp("ball", np.random.default_rng(1)), "ball")
    with pytest.raises(ReportError, match=r"\.png or \.svg"):
        write_picture(tmp_path / "a.txt", figure)


@pytest.mark.slow
def test_commands_work_on_a_selection(aged: Fleet, tmp_path: Path) -> None:
    out = call("archive", "report", aged.archive, "-o", tmp_path / "a.html", "--cell", "press 1")
    assert "press 2" not in out
    data = tmp_path / "a.npz"
    call("archive", "export", aged.archive, "-o", data, "--cell", "press 1", "--object", "box")
    assert "box, press 1" in call("plot", "grasp", 0, data, "-o", tmp_path / "a.png")
    with pytest.raises(CellError, match="no grasp 900"):
        call("plot", "grasp", 900, aged.archive, "-o", tmp_path / "a.png")


@pytest.mark.long
@pytest.mark.timeout(300)
def test_training_learns_the_spread_and_shows_what_it_gains(aged: Fleet, tmp_path: Path) -> None:
    first, second = tmp_path / "first.npz", tmp_path / "second.npz"
    days = ["--days", "2027-01-04..2027-01-05"]
    call("train", aged.archive, "-o", first, "--no-spread", *days)
    out = call("train", aged.archive, "-o", second, "--json", tmp_path / "a.json", *days)
    assert "grasps of 2 days left out in turn: named rightly" in out
    assert "grasps of 2 cells left out in turn: named rightly" in out
    spread = json.loads((tmp_path / "a.json").read_text())["spread"]
    assert 0.0 < spread["offset_sd_mm"] < 3.0
    assert {one["what"] for one in spread["left_out"]} == {"days", "cells", "individuals"}
    out = call("compare", first, second, aged.archive, "--days", "2027-01-07..2027-01-08")
    assert "of 24 grasps" in out
    with pytest.raises(CellError, match="both taught"):
        call("compare", first, second, aged.other_objects)


@pytest.mark.long
@pytest.mark.timeout(300)
def test_evaluation_leaves_days_and_cells_out(aged: Fleet) -> None:
    few = ["--recognizer", "shrinkage_lda", "--fuse", "1"]
    out = call("evaluate", aged.archive, "--split", "cells", *few)
    assert "cells: 60 grasps to train, 120 to test, 3 objects" in out
    out = call(
        "evaluate", aged.archive, "--split", "days", "--object", "ball", "--object", "pen", *few
    )
    assert "2 objects" in out
    with pytest.raises(CellError, match="none can be left out"):
        call("evaluate", aged.archive, "--split", "cells", "--cell", "press 1", *few)
    with pytest.raises(CellError, match="no labelled grasp"):
        call("evaluate", aged.archive, "--object", "nothing", *few)
