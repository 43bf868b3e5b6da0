"""The report page: complete, self-contained, small, and never interpreting what it shows."""

import base64
import json
import re
import shutil
from collections import defaultdict
from copy import copy
from dataclasses import asdict, replace
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

from cell.config.file import recorded_config
from cell.errors import RecordingError, ReportError
from cell.recording.reader import Recording, read_recording
from cell.recording.recorder import Recorder
from cell.report import recorded
from cell.report.confusion import ConfusionTable, paper_table, score
from cell.report.page import (
    Page,
    colour,
    drawing,
    new_figure,
    pad_svg,
    percent,
    picture,
    render_report,
    write_report,
)
from cell.report.recorded import (
    MAX_SEQUENCES,
    Answered,
    HealthRow,
    answers_of,
    count,
    drawn_answers,
    health,
    pressure_view,
    recorded_report,
)
from cell.report.shapes import MAX_BARS, shapes_view
from gripper.force.timing import Distribution, LoopStatistics
from recognition.recognizer import UNKNOWN, Posterior
from recognition.statistics.fusion import fuse
from tactile.layout import paper_layout
from tests.fuzz.harness import Clock
from tests.values import make_pads, make_shape

LAYOUT = paper_layout()
INNER = ["finger0.inner", "finger1.inner"]


def identified(held: str, label: str, *posteriors: Posterior, **changes: Any) -> Answered:
    known = {"fused": fuse(posteriors), "posteriors": posteriors, "n_grasps": len(posteriors)}
    return Answered(held=held, label=label, **known | changes)


def page_of(labels: tuple[str, ...] = (), **blocks: Any) -> str:
    return render_report(Page(title="t", labels=labels, sections={"a": {"title": "A", **blocks}}))


class Outline:
    """What a page is made of; its tags are balanced, and no script hides in an attribute."""

    def __init__(self, page: str) -> None:
        root = ElementTree.fromstring(page.removeprefix("<!doctype html>"))
        self.elements = list(root.iter())
        assert not [name for one in self.elements for name in one.attrib if name.startswith("on")]
        self.tags = [one.tag for one in self.elements]
        self.text = [*root.itertext(), *self.values("alt")]

    def values(self, *names: str) -> list[str]:
        """Return the values of some attributes."""
        attributes = (one.get(name) for one in self.elements for name in names)
        return [value for value in attributes if value is not None]


@pytest.fixture(scope="module")
def recording(taught: Any) -> Recording:
    """Five grasps of ball, five of box, then one identification of each."""
    return read_recording(taught.result.recording)


@pytest.fixture(scope="module")
def report(recording: Recording) -> Page:
    return recorded_report(recording)


@pytest.fixture(scope="module")
def page(report: Page, tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("report") / "report.html"
    write_report(path, report)
    return path.read_text("utf-8")


def test_page_has_each_part_and_needs_nothing_but_itself(page, report) -> None:
    assert len(page.encode()) < 3_000_000
    outline = Outline(page)
    parts = ("result", "shapes", "sequences", "examples", "health", "cell", "notes")
    assert tuple(report.sections) == parts
    assert {*parts} <= {*outline.values("id")}
    for place, label in enumerate(report.labels):
        assert f'class="chip c{place}"></span>{label}' in page
        assert f".c{place} {{ background: {colour(place)}; }}" in page
    assert not {"script", "link", "iframe", "object"} & set(outline.tags)
    references, ids = outline.values("src", "href", "xlink:href"), outline.values("id")
    images = [one for one in references if not one.startswith("#")]
    assert {one[1:] for one in references if one not in images} <= set(ids)
    assert len(set(ids)) == len(ids)
    assert "default-src 'none'" in page
    assert not re.findall(r"https?://[^\s\"'<]+", page)
    assert len(images) == 2
    drawn = [base64.b64decode(one.removeprefix("data:image/svg+xml;base64,")) for one in images]
    pads = re.findall(r"<svg.*?</svg>", page, flags=re.DOTALL)
    assert len(pads) == 2 * 4 * 2
    for one in (*drawn, *pads):
        ElementTree.fromstring(one)
    for words in (b"set-point", b"goal current / mA", b"opening / mm"):
        assert all(words in one for one in drawn)


NASTY = "<script>alert('x')</script>&\"$\\frac{1}{2}$ id=\""


def test_labels_and_paths_are_shown_not_interpreted() -> None:
    p = Posterior(labels=(NASTY, "b"), probability=np.array([0.7, 0.3]), unknown=0.1)
    one = identified(NASTY, "b", p, notes=(NASTY,), place=NASTY, shape=make_shape("oval", 6.0))
    table = ConfusionTable(
        name=NASTY, labels=(NASTY,), columns=(NASTY,), counts=np.ones((1, 1), int), caption=NASTY
    )
    with drawing():
        figure = picture(new_figure(1.0, 1.0), NASTY)
    page = page_of(
        (NASTY, "b"),
        lead=NASTY,
        lines=[NASTY],
        tables=[table],
        figures={NASTY: figure},
        rows=[(NASTY,), (NASTY,)],
        shapes=shapes_view([(NASTY, UNKNOWN, make_shape("oval", 6.0))], {NASTY: NASTY}),
        answers=[one],
        groups={NASTY: [HealthRow(NASTY, NASTY, note=NASTY)]},
        facts={NASTY: {NASTY: NASTY}},
        notes=[NASTY],
    )
    outline = Outline(page)
    assert "script" not in outline.tags
    assert sum(NASTY in text for text in outline.text) == 25


def test_darker_shade_means_more_pressure_and_a_touched_side_is_drawn(recording) -> None:
    taxels = LAYOUT.taxels_of(0)
    values = np.zeros(taxels.stop - taxels.start)
    values[:4] = (0.0, 50.0, 130.0, 255.0)
    pad = ElementTree.fromstring(pad_svg(1e3 * LAYOUT.taxel_xy_m[taxels], values, 255.0, "a"))
    rects = {path.get("class"): str(path.get("d")).count("z") for path in pad}
    assert rects == {"s1": 61, "s3": 1, "s7": 1, "s12": 1}
    assert pad.get("viewBox") == "0 0 55 20"
    grasp = recording.grasps[0]
    names, gripping = [pad.name for pad in LAYOUT.pads], LAYOUT.gripping_pads
    view = pressure_view(grasp, names, gripping)
    forces = [f"{share * grasp.force_n.max():.1f} N" for share in (0.25, 0.5, 0.75, 1.0)]
    assert [force for force, *_ in view["levels"]] == forces
    pressed = grasp.counts[-5:].mean(axis=0) - grasp.rest_counts
    assert view["levels"][-1][1] == pytest.approx(pressed.max())
    assert view["n_untouched"] == 8
    side = np.array(grasp.counts)
    side[9:, LAYOUT.taxels_of(2).start + 3] = 80
    touched = pressure_view(replace(grasp, counts=side), names, gripping)
    for one, names in ((view, INNER), (touched, [INNER[0], "finger0.side_a", INNER[1]])):
        assert all([name for name, _ in pads] == names for *_, pads in one["levels"])


def test_a_card_has_shape_and_size_and_the_share_of_its_bar() -> None:
    p = Posterior(labels=("ball", "cylinder"), probability=np.array([0.001, 0.999]), unknown=0.23)
    pin = make_shape("cylinder", 6.1)
    for answer, share, kind in (("cylinder", 77, "cylinder,"), (UNKNOWN, 23, "a cylinder of")):
        page = page_of(p.labels, answers=[identified("", answer, p, shape=pin)])
        assert f"{kind} 6.1 mm (5.8 to 6.4)" in page
        bar = re.findall(r'width:([0-9.]+)%" title="([^"]+)"', page)
        assert sum(float(width) for width, _ in bar) == pytest.approx(2 * 100.0, abs=0.4)
        assert bar[-1 if answer == UNKNOWN else -2][1] == f"{answer} {share} %"
        assert answer == UNKNOWN or f'<span class="mark">{share} %' in page
    assert percent(0.99999) == "99.99 %"


def test_many_labels_make_a_dense_table_and_few_sequences() -> None:
    labels = tuple(f"object {i}" for i in range(36))
    table = ConfusionTable(
        name="all", labels=labels, columns=(*labels, UNKNOWN), counts=np.eye(36, 37, dtype=int)
    )
    p = Posterior(labels=labels, probability=np.full(36, 1 / 36), unknown=0.0)
    answers = [
        identified(truth, answer, p)
        for truth in labels
        for answer in (truth, "object 1", "object 0")
    ]
    # Two of each object, the wrong ones first.
    verdicts = [one.verdict for one in drawn_answers(answers)]
    assert (verdicts.count("wrong"), verdicts.count("right")) == (70, 2)
    others = [replace(one, held=f"another {one.held}") for one in answers]
    assert len(drawn_answers([*answers, *others])) == MAX_SEQUENCES
    page = page_of(labels, tables=[table.without_empty()], n_hidden=36)
    assert 'class="confusion dense"' in page
    assert "36 more are not drawn" in page
    assert f'<th scope="col">{UNKNOWN}</th>' not in page  # nobody was named so


def test_a_table_has_its_labels_and_the_answers_that_were_given() -> None:
    smaller = score("", ["a", "b"], ["b", "b"], ["a", "b"]).without_empty()
    assert (smaller.columns, smaller.counts.tolist()) == (("a", "b"), [[0, 1], [0, 1]])
    assert score("", ["a"], ["x"], ["a"]).without_empty().columns == ("a", UNKNOWN)
    untaught = score("", [UNKNOWN, UNKNOWN, "a"], [UNKNOWN, "a", UNKNOWN], ["a", UNKNOWN])
    assert untaught.text == "1 of 3 right, 1 UNKNOWN, 1 wrong"
    page = page_of(paper_table().labels, tables=[paper_table()])
    assert "96.0 %" in page
    assert "86.5 to 98.9" in page  # Wilson


def test_health_marks_what_is_wrong() -> None:
    assert [count("lost", *of).state for of in ((0, 0), (1, 100), (2, 100), (1, 0))] == [
        "ok", "warn", "bad", "bad",
    ]  # fmt: skip

    def states(period_s: float | None = None, **values: Any) -> dict[str, str]:
        rows = [row for group in health(values, period_s).values() for row in group]
        return {row.name: row.state for row in rows}

    def loop(**counts: Any) -> dict[str, str]:
        return states(0.005, **asdict(LoopStatistics(**counts)))

    frames = states(tactile=defaultdict(int, complete=1000, lost=1, corrupt=11))
    assert (frames["lost"], frames["corrupt"], frames["torn"]) == ("warn", "bad", "ok")
    assert states(tactile=defaultdict(int, lost=1))["complete"] == "bad"
    bus = states(servo_bus=defaultdict(int, transactions=1000, retries=1, timeouts=20))
    assert (bus["transactions"], bus["retries"], bus["timeouts"]) == ("ok", "warn", "bad")
    assert loop(cycles=1000, late=2, lateness=Distribution(max_s=0.011)) == {
        "periods": "plain", "late": "warn", "overruns": "ok", "missed reads": "ok",
        "worst lateness": "bad", "reading the servos": "plain", "oldest force used": "plain",
    }  # fmt: skip
    assert loop(lateness=Distribution(max_s=0.004))["worst lateness"] == "warn"


def test_unwritable_place_is_a_clear_error(tmp_path) -> None:
    with pytest.raises(ReportError, match=r"cannot write report .* make it first"):
        write_report(tmp_path / "no" / "r.html", Page(title="t", sections={}))
    with pytest.raises(ReportError, match="the name of a report must end with"):
        write_report(tmp_path / "cell.yaml", Page(title="t", sections={}))


# -- shape and size ----------------------------------------------------------------------------


def test_all_shapes_are_drawn_on_one_scale() -> None:
    rows = (
        ("pin", "ball", make_shape("cylinder", 6.0)),
        ("pin", "ball", make_shape("oval", 6.2)),
        ("pin", "ball", None),
        ("bar", UNKNOWN, make_shape("flat", 10.0, 15.9)),
    )
    view = shapes_view(rows, {"pin": "true 6.0 mm"})
    pin, bar = view["groups"]
    assert pin["label"] == "pin"
    assert pin["kinds"] == "cylinder 1 of 3, oval 1 of 3, without shape 1 of 3"
    assert pin["text"] == "median 6.1 mm, intervals 0.6 mm wide; true 6.0 mm"
    assert bar["kinds"] == "flat 1 of 1"
    assert bar["text"] == "10.0 mm (9.7 to 10.3) and 15.9 mm (15.6 to 16.2)"
    ticks, at = view["ticks_mm"], view["at"]
    assert (at(1e-3 * ticks[0]), at(1e-3 * ticks[-1])) == pytest.approx((0.0, 100.0))
    every = [one for group in view["groups"] for s in group["shapes"] for one in s.thicknesses]
    assert len(every) == 4
    assert all(0.0 <= at(one.low_m) < at(one.size_m) < at(one.high_m) <= 100.0 for one in every)
    ((_, stranger),) = view["strangers"]
    page = page_of(shapes=view)
    assert f"UNKNOWN: {stranger}" in page
    assert f'style="left:{at(15.9e-3):.2f}%"' in page
    many = shapes_view([("pin", UNKNOWN, make_shape("oval", 6.2))] * (MAX_BARS + 5))
    (group,) = many["groups"]
    assert (len(group["shapes"]), group["kinds"]) == (MAX_BARS, "oval 35 of 35")
    assert (len(many["strangers"]), many["n_hidden"]) == (MAX_BARS, 5)
    assert shapes_view([("pin", "ball", None)]) is None


# -- The report of a recording: whole, old, cut or spoiled -----------------------------------------


def changed(recording: Recording, **values: Any) -> Recording:
    other = copy(recording)
    vars(other).update(values)
    return other


def with_config(recording: Recording, text: str) -> Recording:
    return changed(recording, metadata=recording.metadata | {"config": text})


def captions(page: Page) -> list[str]:
    return [caption for _, caption, _ in page.tiles]


def test_figures_tables_and_files_of_a_run(recording, report, taught) -> None:
    assert "10 grasps taught, 2 identifications" in report.subtitle
    facts = report.sections["cell"]["facts"]
    assert "XM430-W350 (id 1)" in facts["Cell"]["Servos"]
    assert facts["Files"] == {
        name: str(getattr(taught.result, key))
        for name, key in (("Recording", "recording"), ("Model", "model"))
    }
    assert "Simulated cell" in report.sections["notes"]["notes"][-1]
    assert [*report.sections["health"]["groups"]] == ["Tactile frames", "Servo bus", "Force loop"]
    assert captions(report) == [
        *("right", "right with one grasp", "right by the paper's method", "grasps for each part")
    ]
    # The tables are those that the job counts and prints.
    tables = report.sections["result"]["tables"]
    for table, counted in zip(tables, taught.result.scores.values(), strict=True):
        assert (table.name, table.labels) == (counted.name, counted.labels)
        assert table.text == counted.text
    answers = list(answers_of(recording, taught.config))
    for one, part, trial in zip(answers, taught.result.parts, taught.result.trials, strict=True):
        assert (one.held, one.label) == (part.presented, part.label)
        assert one.n_grasps == len(one.posteriors) == len(trial.records)
        assert str(one.shape) == str(trial.shape)
        first = trial.records[0]
        assert one.notes[0] == f"{first.reached}; {first.step.force_n:.1f} N"


def test_the_papers_method_as_recognizer_of_the_cell_has_one_table(recording) -> None:
    config = json.loads(recording.metadata["config"])
    config["recognition"]["recognizer"] = "level_check"
    page = recorded_report(with_config(recording, json.dumps(config)))
    assert captions(page) == ["right", "right with one grasp", "grasps for each part"]


def test_a_page_says_what_the_recording_has_beside_the_answers(recording, monkeypatch) -> None:
    ours = ConfusionTable(
        name="Paper", labels=("ball", "box"), columns=("ball", "box"), counts=np.eye(2, dtype=int)
    )
    monkeypatch.setattr(recorded, "paper_table", lambda: ours)
    early = tuple(row | {"n_ended_early": 1} for row in recording.results)
    fault = {"t_s": 1.0, "kind": "fault", "text": "a cable is loose"}
    page = recorded_report(changed(recording, results=early, events=(fault,)))
    assert "right by the paper's method" not in captions(page)  # it needs whole ramps
    assert page.sections["result"]["tables"][0].name == "Paper"  # of the same objects
    assert "a cable is loose" in page.sections["notes"]["notes"]
    assert ".plot, .chip, .stack i { filter: invert(1)" in render_report(page)
    config = json.loads(recording.metadata["config"])
    config["sequence"]["regrasp"] = "none"
    again = changed(recording, results=(recording.results[-1] | {"n_grasps": 9},))
    free, held = (
        [one.grasps for one in answers_of(again, recorded_config(text))]
        for text in (recording.metadata["config"], json.dumps(config))
    )
    assert len(free[0]) > 1
    assert held[0] == free[0][-1:]


def test_a_recording_without_optional_values_shows_the_others(recording, report) -> None:
    def without(rows: Any, *names: str) -> Any:
        return tuple({k: v for k, v in row.items() if k not in names} for row in rows)

    few = changed(
        recording,
        results=without(recording.results, "held", "grasp_answers"),
        statistics=without(recording.statistics, "tactile", "servo_bus"),
    )
    page = recorded_report(few)
    assert page.sections["cell"] == report.sections["cell"]
    assert [*page.sections["health"]["groups"]] == ["Force loop"]
    assert page.tiles[0][0] == "2 of 2"
    text = render_report(page)
    assert text.count("card sequence named-verdict") == 2
    assert '<section id="result">' not in text
    strange = recorded_report(with_config(recording, '{"unknown": 1}')).sections
    level = strange["examples"]["grasps"][0]["levels"][-1]
    assert [name for name, _ in level[2]] == ["pad 0", "pad 5"]
    assert strange["cell"]["facts"]["Cell"] == {"Sensor": "408 taxels on 10 pads"}
    assert "config in the recording is not valid" in strange["notes"]["notes"][-1]


def test_a_recording_that_was_cut_says_so_and_an_empty_one_is_refused(recording, tmp_path) -> None:
    cut = tmp_path / "cut.mcap"
    shutil.copyfile(recording.path, cut)
    with cut.open("r+b") as file:
        file.truncate(cut.stat().st_size // 2)
    page = recorded_report(read_recording(cut))
    assert page.sections["notes"]["notes"][0].startswith("The recording is not complete: ")
    assert captions(page) == ["grasps taught"]
    assert '<section id="sequences">' not in render_report(page)
    Recorder(tmp_path / "empty.mcap", Clock(), pads=make_pads(((4, 3), (4, 3)))).close()
    with pytest.raises(RecordingError, match="no whole grasp and no answer"):
        recorded_report(read_recording(tmp_path / "empty.mcap"))


@pytest.mark.parametrize(
    "spoil",
    [
        {"poses": ({"t_s": 1.0, "x_m": "far"},)},
        {"events": ({"t_s": "soon", "kind": "place", "text": "a at b"},)},
        {"results": ({"t_s": 1.0, "label": "ball", "labels": ["ball"], "n_grasps": 1},)},
    ],
)
def test_values_that_no_cell_has_are_refused(recording, spoil) -> None:
    with pytest.raises(RecordingError, match="a message has impossible values"):
        recorded_report(changed(recording, **spoil))
