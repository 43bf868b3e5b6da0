"""The report of a recording: pressure, answers, health of the links.

It uses only the recording, so `run` and `recording report` write the same page.
"""

from bisect import bisect_right
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from itertools import pairwise
from math import nan
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cell.config.file import recorded_config
from cell.config.model import CellConfig
from cell.config.tactile import layout_from_config
from cell.control.plan import Pose
from cell.control.records import pad_array
from cell.errors import CellError, RecordingError, reason_text
from cell.learning.parallel import one_blas_thread
from cell.learning.shape_reading import in_words
from cell.learning.training import train
from cell.recording.reader import Recording, between
from cell.report.confusion import BASELINE, ConfusionTable, paper_table, score_tables
from cell.report.page import Page, pad_svg, percent, picture, timeline_figure
from cell.report.shapes import shapes_view
from cell.simulation import true_sizes
from recognition.grasp import Grasp, PadArray
from recognition.recognizer import DEPENDENCE, UNKNOWN, Posterior, answer_probability
from recognition.shape.answer import ShapeAnswer, Thickness
from recognition.statistics.fusion import fuse

MAX_SEQUENCES = 80
"""Most identifications on a page; the page counts the others."""
_SEQUENCES_PER_OBJECT = 2
"""Most identifications of each object on a page."""
_LEVELS, _LEVEL_FRAMES = 4, 5
"""Number of forces of the ramp with a picture, and of frames in the mean of a picture."""
UNTOUCHED_SHARE = 0.10
"""Largest reading of an untouched pad as a share of full scale: noise stays below 8 %."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Answered:
    """A recorded identification."""

    held: str
    """True name if known, else empty."""
    label: str
    """The answer."""
    fused: Posterior
    """Answer of all grasps together."""
    n_grasps: int
    whole_ramps: bool = True
    """Number of grasps, and whether no ramp ended early."""
    posteriors: tuple[Posterior, ...] = ()
    """Answer of each single grasp, in order; empty if not known."""
    notes: tuple[str, ...] = ()
    """Pose and force of each grasp; not of further ramps in the same grip."""
    grasps: tuple[Grasp, ...] = ()
    """The grasps, without further ramps in the same grip."""
    shape: ShapeAnswer | None = None
    place: str = ""
    """Shape and size, and the place of release; empty if not known."""

    @property
    def name(self) -> str:
        """True name if known, else the answer."""
        return self.held or self.label

    @property
    def truth(self) -> str:
        """The right answer: `UNKNOWN` for an object that was never taught; empty if not known."""
        return self.held if not self.held or self.held in self.fused.labels else UNKNOWN

    @property
    def verdict(self) -> str:
        """Return ``right``, ``unknown``, ``wrong``, or ``named`` where the truth is not known."""
        if self.label == self.truth:
            return "right"
        return "unknown" if self.label == UNKNOWN else "wrong" if self.held else "named"

    @property
    def share(self) -> float:
        """Probability of the answer, see `answer_probability`."""
        return answer_probability(self.label, self.fused.probabilities)

    @property
    def shape_text(self) -> str:
        """Shape and size as text."""
        if self.shape is None:
            return ""
        return in_words(self.shape) if self.label == UNKNOWN else str(self.shape)

    @property
    def steps(self) -> list[tuple[int, str, Posterior, Posterior | None]]:
        """Number and note of each grasp, the answer of all grasps so far, and that of this one."""
        notes = (*self.notes, *[""] * self.n_grasps)
        return [
            (i, notes[i - 1], fuse(self.posteriors[:i]), self.posteriors[i - 1])
            for i in range(1, len(self.posteriors) + 1)
        ] or [(self.n_grasps, "", self.fused, None)]


@one_blas_thread()
def recorded_report(recording: Recording) -> Page:
    """Return the page of a recording.

    Raises RecordingError if it has neither grasps nor answers, or impossible values. Raises
    MissingExtraError without matplotlib.
    """
    path = recording.path
    if not recording.grasps and not recording.results:
        raise RecordingError(f"{path} has no whole grasp and no answer; name another recording")
    try:
        return _page(recording)
    except (KeyError, TypeError, ValueError, AttributeError, ArithmeticError) as cause:
        raise RecordingError(
            f"{path}: a message has impossible values ({reason_text(cause)}); name another "
            "recording"
        ) from cause


def _page(recording: Recording) -> Page:
    config = recorded_config(recording.metadata.get("config", ""))
    names, gripping = _pads(recording.pads, config)
    answers = list(answers_of(recording, config))
    taught = [grasp for grasp in recording.grasps if grasp.label]
    paper = paper_table()
    tables = [paper] if {answer.held for answer in answers} == set(paper.labels) else []
    named = [table.labels for table in tables] + [(o.held, o.label) for o in answers if o.held]
    named += [answer.fused.labels for answer in answers]
    labels = tuple(dict.fromkeys(name for some in named for name in some if name != UNKNOWN))
    recognizer = config.recognition.recognizer if config else "cell"
    scores = _scores(answers, taught, recognizer, labels)
    tables += scores.values()
    drawn = drawn_answers(answers)
    sizes = true_sizes(config) if config else {}
    shapes = shapes_view([(answer.held, answer.label, answer.shape) for answer in answers], sizes)
    name = config.name if config else recording.metadata.get("cell", "recorded cell")
    started = datetime.fromtimestamp(1e-9 * recording.wall_clock_start_ns)
    loop_s = recording.cycles.t_s
    period_s = float(np.median(np.diff(loop_s))) if len(loop_s) > 1 else None
    grasps = [
        _grasp_view(recording, label, i) | pressure_view(recording.grasps[i], names, gripping)
        for label, i in _examples(recording, answers)
    ]
    sections: dict[str, dict[str, Any]] = {
        "result": {"title": "Confusion", "tables": [table.without_empty() for table in tables]},
        "shapes": {"title": "Shape and size", "shapes": shapes},
        "sequences": {
            "title": "Identifications",
            "answers": drawn,
            "n_hidden": len(answers) - len(drawn),
        },
        "examples": {"title": "Grasps", "grasps": grasps},
        "health": {
            "title": "Links",
            "groups": health(recording.statistics[-1], period_s) if recording.statistics else {},
        },
        "cell": {
            "title": "Cell and files",
            "facts": {"Cell": _facts(config, recording.pads), "Files": _files(recording)},
        },
        "notes": {"title": "Notes", "notes": _notes(recording, config, compared=len(scores) > 2)},
    }
    return Page(
        title="Report of the cell",
        subtitle=f"{started:%Y-%m-%d %H:%M} · {name}: {len(taught)} grasps taught, "
        f"{len(answers)} identifications",
        tiles=_tiles(scores, answers, len(taught)),
        labels=labels,
        sections=sections,
    )


def _pads(pads: PadArray, config: CellConfig | None) -> tuple[list[str], tuple[int, ...]]:
    """Return the names of the pads and the numbers of the gripping ones, by the config if it fits.

    Else the first pad of each half of the pads grips.
    """
    if config is not None and pad_array(layout := layout_from_config(config.tactile)).same_as(pads):
        return [pad.name for pad in layout.pads], layout.gripping_pads
    return [f"pad {number}" for number in range(pads.n_pads)], (0, pads.n_pads // 2)


def answers_of(recording: Recording, config: CellConfig | None) -> Iterator[Answered]:
    """Yield the identifications, each with the unlabelled grasps before its answer."""
    in_one_grip = config is not None and config.sequence.regrasp == "none"
    ends_s = [*(float(row["t_s"]) for row in recording.results), np.inf]
    placed = [
        (float(row["t_s"]), row["text"]) for row in recording.events if row["kind"] == "place"
    ]
    for (row, met), (end_s, next_s) in zip(recording.identified, pairwise(ends_s), strict=True):
        labels = tuple(row["labels"])
        counted = met[-1:] if in_one_grip else met
        places = [text.rpartition(" at ")[2] for t_s, text in placed if end_s <= t_s < next_s]
        yield Answered(
            held=row.get("held", ""),
            label=row["label"],
            fused=_posterior(labels, row),
            posteriors=tuple(_posterior(labels, values) for values in row.get("grasp_answers", ())),
            n_grasps=row["n_grasps"],
            whole_ramps=not row.get("n_ended_early"),
            grasps=tuple(recording.grasps[i] for i in counted),
            notes=tuple(
                f"{_pose(recording, i)}; {_force_n(recording.grasps[i]):.1f} N" for i in counted
            ),
            shape=_shape(row["shape"]) if row.get("shape") else None,
            place=places[-1] if places else "",
        )


def _posterior(labels: tuple[str, ...], row: Mapping[str, Any]) -> Posterior:
    return Posterior(
        labels=labels,
        probability=np.array(row["probabilities"], dtype=np.float64),
        unknown=row["unknown"],
        dependence=row.get("dependence", DEPENDENCE),
    )


def _shape(row: Mapping[str, Any]) -> ShapeAnswer:
    return ShapeAnswer(
        kind=row["kind"],
        probability={row["kind"]: row["probability"]},
        **{name: row[name] for name in ("size_m", "low_m", "high_m")},
        dimensions_m=row.get("dimensions_m", {}),
        misfit=nan,
        thicknesses=tuple(Thickness(**values) for values in row["thicknesses"]),
    )


def _pose(recording: Recording, grasp: int) -> str:
    """Return the pose of a grasp by its number."""
    stamps_s = [row["t_s"] for row in recording.poses]
    place = bisect_right(stamps_s, recording.grasp_t_s[grasp])
    if not place:
        return "pose not recorded"
    row = recording.poses[place - 1]
    return str(Pose(**{key: value for key, value in row.items() if key != "t_s"}))


def _force_n(grasp: Grasp) -> float:
    return grasp.command.force_n if grasp.command else float(np.nanmax(grasp.force_n))


def _scores(
    answers: list[Answered], taught: list[Grasp], default: str, labels: Sequence[str]
) -> dict[str, ConfusionTable]:
    """Return the tables of the identifications whose held object is known.

    The paper's classifier is taught with the same grasps. It needs whole ramps.
    """
    try:
        baseline = train(taught, BASELINE).recognizer if taught else None
    except CellError:  # too few grasps
        baseline = None
    known = [answer for answer in answers if answer.held]
    first = all(answer.posteriors and answer.grasps for answer in known)
    compared = first and default != BASELINE and all(answer.whole_ramps for answer in known)
    trials = []
    for answer in known:
        posteriors = {default: answer.posteriors[0]} if first else {}
        if compared and baseline is not None:
            posteriors[BASELINE] = baseline.posterior(answer.grasps[0])
        trials.append((answer.truth, answer.label, posteriors))
    named = {label for truth, label, _ in trials for label in (truth, label)}
    rows = [label for label in labels if label in named and label != UNKNOWN]
    untaught = [UNKNOWN] if any(truth == UNKNOWN for truth, *_ in trials) else []
    return score_tables(trials, [*rows, *untaught], default)


def drawn_answers(answers: list[Answered]) -> list[Answered]:
    """Return some identifications of each object: first the wrong ones, then the longest.

    They are the most useful ones for a reader; the tables count all.
    """
    drawn = []
    for name in dict.fromkeys(answer.name for answer in answers):
        named = [answer for answer in answers if answer.name == name]
        named.sort(key=lambda answer: (answer.verdict == "right", -answer.n_grasps))
        drawn += named[:_SEQUENCES_PER_OBJECT]
    return drawn[:MAX_SEQUENCES]


def _examples(recording: Recording, answers: list[Answered]) -> list[tuple[str, int]]:
    """Return name and number of the strongest grasp of each object, of taught ones if there are."""
    named = {id(grasp): answer.name for answer in answers for grasp in answer.grasps}
    examples: dict[str, int] = {}
    grasps = [(i, grasp) for i, grasp in enumerate(recording.grasps) if grasp.commanded]
    for i, grasp in sorted(grasps, key=lambda pair: (bool(pair[1].label), _force_n(pair[1]))):
        if name := grasp.label or named.get(id(grasp)):
            examples[name] = i  # the last one stays
    return sorted(examples.items(), key=lambda example: example[1])


def _grasp_view(recording: Recording, label: str, number: int) -> dict[str, Any]:
    """Return one grasp: force, current and opening over time."""
    grasp, begin_s = recording.grasps[number], recording.grasp_t_s[number]
    cycles = between(recording.cycles, begin_s, begin_s + float(grasp.t_s[-1]))
    return {
        "label": label,
        "note": f"{_pose(recording, number)}; ramp to {_force_n(grasp):.1f} N",
        "timeline": picture(timeline_figure(cycles), f"force, current and opening of {label}")
        if len(cycles)
        else "",
    }


def pressure_view(grasp: Grasp, names: Sequence[str], gripping: Sequence[int]) -> dict[str, Any]:
    """Return the touched pads at four equal steps of the force ramp, all on one scale.

    Each is the mean of the frames nearest to its force, the set-point, above rest. ``names`` are
    those of all pads; those of the numbers ``gripping`` are always drawn.
    """
    pads, levels = grasp.pads, []
    for wanted_n in np.linspace(0, float(grasp.force_n.max()), _LEVELS + 1)[1:]:
        # Of equally near frames take the later ones: their pressure has settled.
        near = np.lexsort((-np.arange(grasp.n_frames), np.abs(grasp.force_n - wanted_n)))
        counts = grasp.counts[near[:_LEVEL_FRAMES]].mean(axis=0) - grasp.rest_counts
        levels.append((wanted_n, counts))
    full = max(1.0, *(float(counts.max()) for _, counts in levels))
    taxels = [pads.taxels_of(number) for number in range(pads.n_pads)]
    least, last = UNTOUCHED_SHARE * pads.adc_max, levels[-1][1]
    visible = [i for i, of_pad in enumerate(taxels) if i in gripping or last[of_pad].max() > least]

    def pad(number: int, counts: NDArray[np.float64]) -> tuple[str, str]:
        xy_mm, values = 1e3 * pads.taxel_xy_m[taxels[number]], counts[taxels[number]]
        label = f"pressure map, peak {values.max():.0f} counts"
        return names[number], pad_svg(xy_mm, values, full, label)

    return {
        "levels": [
            (f"{force_n:.1f} N", float(counts.max()), [pad(number, counts) for number in visible])
            for force_n, counts in levels
        ],
        "n_untouched": pads.n_pads - len(visible),
        "full": full,
    }


def _tiles(
    scores: Mapping[str, ConfusionTable], answers: list[Answered], n_taught: int
) -> list[tuple[str, str, str]]:
    if not answers:
        return [(str(n_taught), "grasps taught", "")]
    captions = ("right", "right with one grasp", "right by the paper's method")
    tiles = [
        (percent(table.accuracy), caption, f"{table.n_right} of {table.n}")
        for table, caption in zip(scores.values(), captions, strict=False)
    ]
    if not tiles:
        n_named = sum(answer.label != UNKNOWN for answer in answers)
        tiles.append((f"{n_named} of {len(answers)}", "with a name", ""))
    per_answer = np.mean([answer.n_grasps for answer in answers])
    return [*tiles, (f"{per_answer:.1f}", "grasps for each part", "")]


def _facts(config: CellConfig | None, pads: PadArray) -> dict[str, str]:
    facts = {"Sensor": f"{pads.n_taxels} taxels on {pads.n_pads} pads"}
    if config is None:
        return facts
    gripper, tactile, sequence = config.gripper, config.tactile, config.sequence
    servos = ", ".join(f"{servo.model} (id {servo.id})" for servo in gripper.servos)
    facts |= {"Servos": servos, "Servo bus": f"{gripper.port}, {gripper.baud_rate:,} baud"}
    if tactile.serial_ports:
        facts["Sensor boards"] = tactile.place
    else:
        node = f", node {tactile.node_id}" if tactile.sensor.canopen else ""
        facts["CAN"] = f"{tactile.place}, {tactile.bitrate:,} bit/s{node}"
    facts |= {
        "Force": "{:g} to {:g} N".format(*sequence.force_n),
        "Ramp": f"{sequence.ramp.rate_n_s:g} N/s",
        "Position": "x {:g} to {:g} mm, y {:g} to {:g} mm".format(*sequence.x_mm, *sequence.y_mm),
        "Rotation": "{:g} to {:g} deg".format(*sequence.rotation_deg),
        "Seed": str(config.seed),
    }
    if config.simulated:
        facts["Level of the noise"] = f"{config.simulator.noise_level:g}"
    return facts


def _files(recording: Recording) -> dict[str, str]:
    """Return the recording and the model that `run` writes beside it."""
    model = recording.path.with_name("model.npz")
    return {"Recording": str(recording.path)} | ({"Model": str(model)} if model.is_file() else {})


def _notes(recording: Recording, config: CellConfig | None, *, compared: bool) -> list[str]:
    """Return events that the operator should read with the results, and the results' basis."""
    notes = []
    if recording.lost_reason:
        notes.append(f"The recording is not complete: {recording.lost_reason}.")
    if missed := sum(row["kind"] == "no part" for row in recording.events):
        notes.append(f"{missed} grasps found no part.")
    notes += [row["text"] for row in recording.events if row["kind"] in ("drift", "fault", "note")]
    if compared:
        notes.append(
            "The level check names the likeliest object by the taxels of one grasp, never UNKNOWN, "
            "as in the paper. The default recognizer uses whole ramps and several grasps."
        )
    if config is None:
        notes.append("The config in the recording is not valid in this version.")
    elif config.simulated:
        notes.append(
            "Simulated cell: rigid objects in 3 mm foam, servos and control unit with their real "
            "protocols. A real sensor drifts and wears; repeat the measurement on your cell."
        )
    return list(dict.fromkeys(notes))


# Health of the links and of the force loop: the last counts of a recording, with a mark each

State = Literal["ok", "warn", "bad", "plain"]


class HealthRow(NamedTuple):
    """One value of the links' health, and its mark."""

    name: str
    value: str
    state: State = "plain"
    note: str = ""


_LINKS: Mapping[str, tuple[str, str, Mapping[str, str]]] = {
    "tactile": (
        "Tactile frames",
        "complete",
        {
            "lost": "",
            "torn": "incomplete, dropped",
            "duplicate": "messages, dropped",
            "reordered": "messages out of order",
            "stale": "older than the last, dropped",
            "short": "messages, dropped",
            "corrupt": "refused by checksum or phase",
            "late_requests": "",
            "malformed": "other messages, dropped",
            "error_frames": "",
        },
    ),
    "servo_bus": (
        "Servo bus",
        "transactions",
        {
            "retries": "",
            "timeouts": "",
            "corrupt": "answers, never used",
            "late": "answers to an earlier request, dropped",
        },
    ),
}
"""Counts of each link in a recording: title, the count of what was right, what was wrong."""


def health(values: Mapping[str, Any], period_s: float | None) -> dict[str, list[HealthRow]]:
    """Return the rows of each link and of the force loop by a title.

    Parameters
    ----------
    values
        A message of the loop in a recording; a cell without a link has no counts of it.
    period_s
        Length of a period of the loop in s; None for a loop that did not run.
    """
    groups = {}
    for link, (title, right, wrong) in _LINKS.items():
        if counts := values.get(link):
            groups[title] = [
                HealthRow(right, f"{counts[right]:,}", "ok" if counts[right] else "bad"),
                *(count(name, counts[name], counts[right], note) for name, note in wrong.items()),
            ]
    if period_s is not None:
        groups["Force loop"] = _loop(values, period_s)
    return groups


def count(name: str, n: int, total: int, note: str = "") -> HealthRow:
    """Return the row of an error count: one is a warning, more than 1 % of all are bad."""
    state: State = "ok" if not n else "bad" if n > 0.01 * total else "warn"
    return HealthRow(name.replace("_", " "), f"{n:,}", state, note)


def _loop(values: Mapping[str, Any], period_s: float) -> list[HealthRow]:
    def ms(group: str, name: str) -> str:
        return f"{values[group][name] * 1e3:.2f}"

    periods, worst_s = values["cycles"], values["lateness"]["max_s"]
    punctual: State = (
        "ok" if worst_s < 0.5 * period_s else "warn" if worst_s < 2 * period_s else "bad"
    )
    quantiles = {"p50": "p50_s", "p99": "p99_s", "p99.9": "p999_s"}
    tail = ", ".join(f"{name} {ms('lateness', key)}" for name, key in quantiles.items())
    return [
        HealthRow("periods", f"{periods:,}", note=f"of {period_s * 1e3:.1f} ms"),
        count("late", values["late"], periods, "by more than half a period"),
        count("overruns", values["overruns"], periods, "work not done when the next was due"),
        count("missed_reads", values["missed_reads"], periods, "no write to the servos"),
        HealthRow("worst lateness", f"{ms('lateness', 'max_s')} ms", punctual, f"{tail} ms"),
        HealthRow(
            "reading the servos",
            f"{ms('transaction', 'p50_s')} ms",
            note=f"median; p99 {ms('transaction', 'p99_s')} ms",
        ),
        HealthRow("oldest force used", f"{values['sensor_age']['max_s'] * 1e3:.0f} ms"),
    ]
