"""The report page: complete, self-contained, small, and never interpreting what it shows."""

import json
import re
import shutil
import sys
from collections import defaultdict
from collections.abc import Callable
from dataclasses import fields, is_dataclass, replace
from html.parser import HTMLParser
from typing import Any, get_args
from xml.etree import ElementTree

import numpy as np
import pytest

from cell.control.journal import loop_values
from cell.data.recorder import Recorder
from cell.data.recording_reader import RecordedCycles, Recording, read_recording
from cell.errors import MissingExtraError, RecordingError, ReportError
from cell.report.build import level_windows, loop_health, paper_table, servo_health, source_health
from cell.report.data import Answered, ConfusionTable, HealthGroup, HealthState, ReportData
from cell.report.pad_pictures import level_pictures, pressure_levels
from cell.report.page import (
    drawn_sequences,
    label_order,
    render_report,
    sequence_view,
    trajectories_view,
    write_report,
)
from cell.report.recorded import recorded_report
from cell.report.shapes import MAX_BARS, Felt, shapes_view
from gripper.force.timing import LoopStatistics
from recognition.grasp import Grasp
from recognition.quadric.thresholds import find_thresholds
from recognition.recognizer import UNKNOWN, Posterior
from recognition.shape.answer import ShapeAnswer
from recognition.statistics.fusion import fuse
from tactile.layout import TaxelLayout, paper_layout
from tests.cell.conftest import plain_pads
from tests.fuzz.harness import Clock
from tests.values import make_shape

LAYOUT = paper_layout()


def identified(truth: str, answer: str, *posteriors: Posterior, **changes: Any) -> Answered:
    n = len(posteriors)
    known = {"fused": fuse(posteriors), "posteriors": posteriors, "n_grasps": n}
    return Answered(presented=truth, label=answer, **known | changes)


def report(**parts: Any) -> ReportData:
    return ReportData(title="t", created="c", layout=LAYOUT, **parts)


@pytest.fixture(scope="module")
def run(taught: Any) -> ReportData:
    """A small run and the paper's table; its first grasp began 50 s later, one answer is wrong."""
    data = recorded_report(read_recording(taught.result.recording))
    first, *others = data.examples
    late = replace(first, cycles=replace(first.cycles, t_s=first.cycles.t_s + 50.0))
    return replace(
        data,
        examples=(late, *others),
        sequences=(*data.sequences, replace(data.sequences[0], presented="cylinder")),
        confusions=(*data.confusions, paper_table()),
    )


class Outline(HTMLParser):
    """Collects what a page is made of, and checks that its tags are balanced."""

    VOID = frozenset({"meta", "br", "link", "img", "input"})

    def __init__(self, page: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.ids: list[str] = []
        self.references: list[str] = []
        self.text: list[str] = []
        self._open: list[str] = []
        self.feed(page)
        self.close()
        assert not self._open

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        for name, value in attributes:
            assert not name.startswith("on"), "no script may hide in an attribute"
            if name == "id":
                self.ids.append(str(value))
            if name in {"src", "href", "xlink:href"}:
                self.references.append(str(value))
        if tag not in self.VOID:
            self._open.append(tag)

    def handle_startendtag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attributes)
        if tag not in self.VOID:
            self._open.pop()

    def handle_endtag(self, tag: str) -> None:
        assert self._open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text.append(data)


@pytest.fixture(scope="module")
def page(run: ReportData, tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("report") / "report.html"
    write_report(path, run)
    return path.read_text("utf-8")


@pytest.mark.slow
def test_page_needs_nothing_but_itself(page) -> None:
    assert len(page.encode()) < 3_000_000
    outline = Outline(page)
    assert not {"script", "link", "img", "iframe", "object"} & set(outline.tags)
    assert all(reference.startswith("#") for reference in outline.references)
    assert {reference[1:] for reference in outline.references} <= set(outline.ids)
    assert len(set(outline.ids)) == len(outline.ids)
    assert "default-src 'none'" in page
    outside = set(re.findall(r"https?://[^\s\"'<]+", page))
    assert outside <= {"http://www.w3.org/2000/svg", "http://www.w3.org/1999/xlink"}
    pictures = re.findall(r"<svg.*?</svg>", page, flags=re.DOTALL)
    assert len(pictures) == 20
    for picture in pictures:
        ElementTree.fromstring(picture)
    assert "#0101" not in page


def mapped(value: Any, change: Callable[[str], str]) -> Any:
    """Return a part of a report with each text of it changed."""
    if isinstance(value, str):
        return value if value in get_args(HealthState) else change(value)
    if isinstance(value, tuple):
        return tuple(mapped(one, change) for one in value)
    if not is_dataclass(value) or isinstance(
        value, TaxelLayout | Answered | Grasp | RecordedCycles
    ):
        return value
    texts = {field.name: mapped(getattr(value, field.name), change) for field in fields(value)}
    return replace(value, **texts)


@pytest.mark.slow
def test_page_shows_every_part(page, run) -> None:
    text = " ".join("".join(Outline(page).text).split())
    for part in ("result", "sequences", "examples", "trajectories", "health", "cell", "notes"):
        assert f'<section id="{part}">' in page
    texts: list[str] = []
    mapped(run, lambda one: texts.append(one) or one)
    assert len(texts) > 100
    for words in (
        *texts, "48 of 50 right", "2 of 2 right", "named ball", "set-point",
        "goal current / mA", "opening / mm", "The other 8 pads were not touched.",
        # Of 48 and 2 right ones, after Wilson.
        "96.0 %86.5 to 98.9", "100.0 %34.2 to 100.0",
    ):  # fmt: skip
        assert " ".join(words.split()) in text, words
    assert "1.5" in text
    assert "51.5" not in text  # a grasp begins at 0 s
    assert page.count('class="card example"') == 2
    assert page.count('class="pad"') == 2 * 4 * 2
    assert page.count('class="plot"') == 2 + 2


NASTY = "<script>alert('x')</script>&\"$\\frac{1}{2}$ #010110 id=\""


@pytest.mark.slow
def test_labels_and_paths_are_shown_not_interpreted(run) -> None:
    p = Posterior(labels=(NASTY, "b"), probability=np.array([0.7, 0.3]), unknown=0.1)
    one = replace(run.trajectories, objects=run.trajectories.objects[:1], windows=())
    sequence = identified(NASTY, "b", p)
    data = replace(
        mapped(replace(run, trajectories=one), lambda _text: NASTY), sequences=(sequence,)
    )
    outline = Outline(render_report(data))
    assert "script" not in outline.tags
    assert sum(NASTY in text for text in outline.text) >= 14


@pytest.mark.long
def test_same_data_give_the_same_page(page, run) -> None:
    assert render_report(run) == page


def test_darker_shade_means_more_pressure_and_a_touched_side_is_drawn_small() -> None:
    counts = np.zeros(LAYOUT.n_taxels)
    counts[:4] = (0.0, 50.0, 130.0, 255.0)
    counts[LAYOUT.taxels_of(2).start + 3] = 80.0
    pictures = level_pictures(LAYOUT, "1 N", counts, 255.0)
    first = ElementTree.fromstring(pictures["gripping"][0]["svg"])
    rects = {path.get("class"): str(path.get("d")).count("z") for path in first}
    assert rects == {"s0": 61, "s3": 1, "s7": 1, "s12": 1}
    assert first.get("viewBox") == "0 0 55 20"
    assert [pad["name"] for pad in pictures["others"]] == ["finger0.side_a"]
    assert pictures["untouched"][:2] == ["finger0.outer", "finger0.side_b"]
    assert len(pictures["untouched"]) == 7


def test_levels_are_picked_by_force(run) -> None:
    grasp = run.examples[0].grasp
    levels = pressure_levels(grasp)
    most_n = grasp.force_n.max()
    assert list(levels) == [f"{share * most_n:.1f} N" for share in (0.25, 0.5, 0.75, 1.0)]
    *_, highest = levels.values()
    np.testing.assert_allclose(highest, grasp.counts[-5:].mean(axis=0))


@pytest.mark.slow
def test_every_plot_colours_an_object_as_the_legend_does(run) -> None:
    turned = run.trajectories.objects[::-1]
    data = replace(run, trajectories=replace(run.trajectories, objects=turned))
    labels = [item.label for item in turned]
    colours = {label: place for place, label in enumerate(label_order(data))}
    assert labels != sorted(labels, key=colours.__getitem__)
    view = trajectories_view(data, colours)
    # Each object is one line of the sweep, in the order of the trajectories.
    lines = re.findall(r"fill: none; stroke: var\(--c(\d)\)", view["sweep"])
    assert [int(number) for number in lines] == [colours[label] for label in labels]
    ramps = re.findall(r"fill: none; stroke: var\(--c(\d)\); stroke-width: 1.2", view["levels"])
    assert [int(number) for number in ramps] == [colours[label] for label in labels]


def test_the_figure_of_a_card_is_the_share_of_its_bar() -> None:
    p = Posterior(labels=("ball", "cylinder"), probability=np.array([0.001, 0.999]), unknown=0.23)
    for answer in ("cylinder", UNKNOWN):
        view = sequence_view(identified("", answer, p), {"ball": 0, "cylinder": 1})
        bar = {part["label"]: part for part in view["steps"][0]["fused"]}
        assert sum(float(part["share"]) for part in bar.values()) == pytest.approx(100.0)
        assert view["probability"] == bar[answer]["text"]
    assert bar["cylinder"]["text"] == "77 %"


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
    data = report(confusions=(table,), sequences=tuple(answers))
    page = render_report(data)
    assert 'class="confusion dense"' in page
    # Two of each object, the wrong ones first.
    assert (page.count("card sequence wrong"), page.count("card sequence right")) == (70, 2)
    assert "36 more are not drawn" in page
    others = [replace(one, presented=f"another {one.presented}") for one in answers]
    assert len(drawn_sequences(replace(data, sequences=(*answers, *others)))) == 80
    assert f'<th scope="col">{UNKNOWN}</th>' not in page  # nobody was named so


def test_health_marks_what_is_wrong() -> None:
    def states(group: HealthGroup) -> dict[str, str]:
        return {row.name: row.state for row in group.rows}

    def frames(**counts: int) -> dict[str, str]:
        return states(source_health(defaultdict(int, counts)))

    def loop(**counts: Any) -> dict[str, str]:
        return states(loop_health(loop_values(LoopStatistics(**counts)), 0.005))

    assert set(frames(complete=1000).values()) == {"ok"}
    some = frames(complete=1000, lost=1, corrupt=1)
    assert (some["lost"], some["corrupt"], some["torn"]) == ("warn", "bad", "ok")
    assert frames(complete=100, lost=10)["lost"] == "bad"
    assert frames()["whole frames"] == "bad"
    bus = states(servo_health(defaultdict(int, transactions=1000, retries=1, timeouts=20)))
    assert (bus["transactions"], bus["retries"], bus["time-outs"]) == ("ok", "warn", "bad")
    assert loop(cycles=1000, late=2, worst_lateness_s=0.011) == {
        "periods": "plain", "late": "warn", "overruns": "ok", "without feedback": "ok",
        "worst lateness": "bad", "reading the servos": "plain", "oldest force used": "plain",
    }  # fmt: skip
    assert loop(cycles=10, late=1)["late"] == "bad"
    assert loop(worst_lateness_s=0.004)["worst lateness"] == "warn"
    marks = frames(complete=10, requests=10, late_requests=1, error_frames=11)
    assert (marks["late requests"], marks["malformed"], marks["error frames"]) == (
        "warn",
        "ok",
        "bad",
    )
    assert marks["whole frames"] == "ok"


def test_windows_are_named_from_the_lowest_level_upwards() -> None:
    levels = find_thresholds([[4.0, 5.0], [1.0, 2.0], [4.5, 6.0]])
    named = level_windows(levels, ["high", "low", "higher"])
    assert [(w.name, w.below, w.above, w.closed) for w in named] == [
        ("A", "low", "high", False),
        ("B", "high", "higher", True),
    ]
    assert named[0].threshold == pytest.approx(3.0)


@pytest.mark.parametrize("missing", ["jinja2", "matplotlib"])
def test_missing_extra_is_said_with_the_remedy(missing, run, monkeypatch) -> None:
    for name in [name for name in sys.modules if name.split(".")[0] == missing]:
        monkeypatch.setitem(sys.modules, name, None)
    monkeypatch.setitem(sys.modules, missing, None)
    with pytest.raises(
        MissingExtraError, match=rf"needs {missing}; install this project with its extra `report`"
    ):
        render_report(run)


def test_unwritable_place_is_a_clear_error(tmp_path) -> None:
    with pytest.raises(ReportError, match=r"cannot write report .* make it first"):
        write_report(tmp_path / "no" / "r.html", report())


# -- shape and size ----------------------------------------------------------------------------


def felt(truth: str, shape: ShapeAnswer | None, answer: str = "ball") -> Felt:
    return truth, answer, shape


def page_of(*rows: Felt) -> str:
    p = Posterior(labels=("ball", "box"), probability=np.array([0.9, 0.1]), unknown=0.01)
    return render_report(report(sequences=tuple(identified(*r[:2], p, shape=r[2]) for r in rows)))


def test_shape_and_size_stand_beside_each_identification() -> None:
    pin = make_shape("cylinder", 6.1)
    page = page_of(felt("pin", pin), felt("pin", pin, UNKNOWN))
    assert "cylinder, 6.1 mm (5.8 to 6.4)" in page
    assert "a cylinder of 6.1 mm (5.8 to 6.4)" in page
    assert 'id="shapes"' in page
    assert 'id="shapes"' not in page_of(felt("pin", None))


def test_all_shapes_are_drawn_on_one_scale() -> None:
    rows = (
        felt("pin", make_shape("cylinder", 6.0)),
        felt("pin", make_shape("oval", 6.2)),
        felt("pin", None),
        felt("bar", make_shape("flat", 10.0, 15.9), UNKNOWN),
    )
    view = shapes_view(rows, {"pin": "true 6.0 mm"})
    pin, bar = view["groups"]
    assert pin["label"] == "pin"
    assert pin["kinds"] == "cylinder 1 of 3, oval 1 of 3, without shape 1 of 3"
    assert pin["text"] == "median 6.1 mm, intervals 0.6 mm wide; true 6.0 mm"
    assert bar["kinds"] == "flat 1 of 1"
    assert bar["text"] == "10.0 mm (9.7 to 10.3) and 15.9 mm (15.6 to 16.2)"
    (both,) = bar["bars"]
    scale = {float(tick["text"]): float(tick["at"]) for tick in view["ticks"]}
    per_mm = (scale[16.0] - scale[10.0]) / 6.0
    for mark, size_mm in zip(both["marks"], (10.0, 15.9), strict=True):
        assert float(mark["at"]) == pytest.approx(scale[10.0] + per_mm * (size_mm - 10.0), abs=0.05)
        assert float(mark["width"]) == pytest.approx(0.6 * per_mm, abs=0.05)
    marks = [m for group in view["groups"] for b in group["bars"] for m in b["marks"]]
    assert all(0.0 <= float(m["left"]) <= 100.0 - float(m["width"]) for m in marks)
    (stranger,) = view["strangers"]
    page = page_of(*rows)
    assert f"UNKNOWN: {stranger['text']}" in page
    assert "it was bar" in page
    assert "without shape 1 of 3" in page


def test_many_shapes_are_counted_but_not_all_drawn() -> None:
    one = make_shape("cylinder", 6.0)
    rows = [felt("pin", one)] * (MAX_BARS + 5)
    view = shapes_view(rows)
    (group,) = view["groups"]
    assert len(group["bars"]) == MAX_BARS
    assert group["kinds"] == f"cylinder {MAX_BARS + 5} of {MAX_BARS + 5}"
    strange = shapes_view([felt("pin", one, UNKNOWN)] * (MAX_BARS + 5))
    assert (len(strange["strangers"]), strange["n_hidden"]) == (MAX_BARS, 5)


# -- The report of a recording: whole, old, cut or spoiled -----------------------------------------


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
    assert (data.facts, data.confusions) == (recorded_report(recording).facts, ())
    assert [group.title for group in data.health] == ["Force loop"]
    assert data.key_figures[0].value == "2 of 2"
    assert [(one.name, one.presented, one.posteriors) for one in data.sequences] == [
        ("ball", "", ()),
        ("box", "", ()),
    ]
    page = render_report(replace(data, examples=(), trajectories=None))
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
    page = render_report(replace(data, examples=(), trajectories=None))
    assert '<section id="sequences">' not in page
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
