"""The report of a recording: pressure, answers, health of the links.

It uses only the recording, so `run` and `report` write the same page.
"""

from bisect import bisect_right
from collections.abc import Mapping, Sequence
from datetime import datetime
from itertools import pairwise
from math import nan
from typing import Any

import numpy as np

from cell.config.file import recorded_config
from cell.config.model import CellConfig
from cell.config.tactile import (
    TactileConfig,
    layout_from_config,
    layout_from_pads,
)
from cell.control.plan import Pose
from cell.control.records import pad_array
from cell.data.recording_reader import Recording
from cell.errors import CellError, RecordingError, reason_text
from cell.learning.blas import one_blas_thread
from cell.learning.training import train
from cell.report.build import (
    BASELINE,
    level_windows,
    loop_health,
    paper_table,
    score_tables,
    servo_health,
    source_health,
)
from cell.report.data import (
    Answered,
    ConfusionTable,
    HealthGroup,
    KeyFigure,
    ObjectTrajectory,
    ReportData,
    ShownGrasp,
    Trajectories,
)
from cell.simulation import true_sizes
from recognition.errors import ContactError, QuadricError
from recognition.grasp import Grasp
from recognition.quadric.level import grip_surfaces, ramp_levels
from recognition.quadric.trajectory import sweep
from recognition.recognizer import DEPENDENCE, UNKNOWN, Posterior
from recognition.recognizers.level_check import LevelCheckRecognizer
from recognition.shape.answer import ShapeAnswer, Thickness
from tactile.layout import TaxelLayout

_RAMP_SHARES = tuple(np.linspace(0.2, 1.0, 9).tolist())
"""Shares of the grip force for the plot of the eigenvalue along the ramp."""
_FILES = (("Data set", "model.grasps.npz"), ("Model", "model.npz"))
"""Files that `run` writes beside the recording."""


@one_blas_thread()
def recorded_report(recording: Recording) -> ReportData:
    """Return the values of the page of a recording.

    Raises RecordingError if it has neither grasps nor answers, or impossible values, and
    ConfigError if its pads are not those of two fingers.
    """
    path = recording.path
    if not recording.grasps and not recording.results:
        raise RecordingError(f"{path} has no whole grasp and no answer; name another recording")
    try:
        return _Story(recording).data()
    except (KeyError, TypeError, ValueError, AttributeError, ArithmeticError) as cause:
        raise RecordingError(
            f"{path}: a message has impossible values ({reason_text(cause)})"
        ) from cause


class _Story:
    """Contents of a recording: teaching, identifications and the cell."""

    def __init__(self, recording: Recording) -> None:
        self.recording = recording
        self.config = recorded_config(recording.metadata.get("config", ""))
        self.layout = _layout(recording, self.config)
        self.pose_stamps = [float(row["t_s"]) for row in recording.poses]
        self.taught = [grasp for grasp in recording.grasps if grasp.label]
        self.answers = _answers(self)
        self.baseline = self._baseline()

    def data(self) -> ReportData:
        recording, config = self.recording, self.config
        name = config.name if config else recording.metadata.get("cell", "recorded cell")
        started = datetime.fromtimestamp(1e-9 * recording.wall_clock_start_ns)
        scores = self._scores()
        examples = self._examples()
        paper = paper_table()
        tables = tuple(scores.values())
        known = {one.presented for one in self.answers}
        return ReportData(
            title="Report of the cell",
            subtitle=f"{name}: {len(self.taught)} grasps taught, "
            f"{len(self.answers)} identifications",
            created=started.strftime("%Y-%m-%d %H:%M"),
            key_figures=_key_figures(scores, self),
            facts=_facts(config, self.layout),
            layout=self.layout,
            examples=examples,
            trajectories=_trajectories(self.baseline, examples),
            sequences=tuple(self.answers),
            true_sizes=true_sizes(config) if config else {},
            confusions=(paper, *tables) if set(paper.labels) == known else tables,
            health=_health(recording),
            files=(
                ("Recording", str(recording.path)),
                *(
                    (what, str(file))
                    for what, file_name in _FILES
                    if (file := recording.path.with_name(file_name)).is_file()
                ),
            ),
            notes=(
                *_remarks(recording),
                *_notes(config, drawn=bool(self.taught and scores), baseline=BASELINE in scores),
            ),
        )

    def note(self, grasp: Grasp, t_s: float) -> tuple[str, float]:
        """Return the pose of a grasp that began at ``t_s``, and its final force in N."""
        place = bisect_right(self.pose_stamps, t_s)
        if not place:
            return "pose not recorded", _force_n(grasp)
        row = self.recording.poses[place - 1]
        pose = Pose(**{key: value for key, value in row.items() if key != "t_s"})
        return str(pose), _force_n(grasp)

    def _baseline(self) -> LevelCheckRecognizer | None:
        """Return the paper's classifier, taught with the same grasps; None with too few grasps."""
        try:
            recognizer = train(self.taught, BASELINE).recognizer if self.taught else None
        except CellError:  # too few grasps
            return None
        return recognizer if isinstance(recognizer, LevelCheckRecognizer) else None

    def _scores(self) -> dict[str, ConfusionTable]:
        """Return the tables of the identifications whose held object is known.

        The paper's method needs whole ramps.
        """
        default = self.config.recognition.recognizer if self.config else "cell"
        trials = []
        for one in self.answers:
            first: dict[str, Posterior] = {}
            if one.posteriors and one.grasps:
                first[default] = one.posteriors[0]
                if self.baseline is not None and default != BASELINE and not one.n_ended_early:
                    first[BASELINE] = self.baseline.posterior(one.grasps[0])
            if one.presented:
                trials.append((one.presented, one.label, first))
        named = (label for truth, label, _ in trials for label in (truth, label))
        labels = tuple(dict.fromkeys(label for label in named if label != UNKNOWN))
        common = set.intersection(*(set(first) for *_, first in trials)) if trials else set()
        return score_tables(
            [
                (truth, label, {name: first[name] for name in first if name in common})
                for truth, label, first in trials
            ],
            labels,
            default,
        )

    def _examples(self) -> tuple[ShownGrasp, ...]:
        """Return the strongest taught grasp of each object, else its first identified grasp."""
        of_label: dict[str, Grasp] = {}
        for grasp in sorted(self.taught, key=_force_n, reverse=True):
            of_label.setdefault(grasp.label, grasp)
        for one in self.answers if not of_label else ():
            if one.grasps:
                of_label.setdefault(one.name, one.grasps[0])
        order = {id(grasp): place for place, grasp in enumerate(self.recording.grasps)}
        shown = []
        for label, grasp in sorted(of_label.items(), key=lambda item: order[id(item[1])]):
            begin_s = self.recording.grasp_t_s[order[id(grasp)]]
            cycles = self.recording.cycles.between(begin_s, begin_s + float(grasp.t_s[-1]))
            if not len(cycles) or not np.all(np.isfinite(grasp.force_n)):
                continue
            pose, force_n = self.note(grasp, begin_s)
            note = f"{pose}; ramp to {force_n:.1f} N"
            shown.append(ShownGrasp(label=label, note=note, grasp=grasp, cycles=cycles))
        return tuple(shown)


def _force_n(grasp: Grasp) -> float:
    return grasp.command.force_n if grasp.command else float(np.nanmax(grasp.force_n))


def _layout(recording: Recording, config: CellConfig | None) -> TaxelLayout:
    if config is not None:
        layout = layout_from_config(config.tactile)
        if pad_array(layout).same_as(recording.pads):
            return layout
    return layout_from_pads(recording.pads)


def _answers(story: _Story) -> list[Answered]:
    """Return the identifications, each with the unlabelled grasps before its answer."""
    recording, config = story.recording, story.config
    in_one_grip = config is not None and config.sequence.regrasp == "none"
    found = []
    ends_s = [*(float(row["t_s"]) for row in recording.results), np.inf]
    placed = [(float(row["t_s"]), row) for row in recording.events if row["kind"] == "place"]
    for (row, every), (end_s, next_s) in zip(recording.identified, pairwise(ends_s), strict=True):
        met = [
            (recording.grasps[i], recording.grasp_t_s[i])
            for i in (every[-1:] if in_one_grip else every)
        ]
        labels = tuple(map(str, row["labels"]))
        places = [str(event["text"]) for t_s, event in placed if end_s <= t_s < next_s]
        found.append(
            Answered(
                presented=str(row.get("held", "")),
                label=str(row["label"]),
                fused=_posterior(labels, row),
                posteriors=tuple(_posterior(labels, one) for one in row.get("grasp_answers", ())),
                n_grasps=int(row["n_grasps"]),
                n_ended_early=int(row.get("n_ended_early", 0)),
                grasps=tuple(grasp for grasp, _ in met),
                notes=tuple("{}; {:.1f} N".format(*story.note(*one)) for one in met),
                shape=_shape(row["shape"]) if row.get("shape") else None,
                place=places[-1].rpartition(" at ")[2] if places else None,
            )
        )
    return found


def _posterior(labels: tuple[str, ...], row: Mapping[str, Any]) -> Posterior:
    return Posterior(
        labels=labels,
        probability=np.array(row["probabilities"], dtype=np.float64),
        unknown=float(row["unknown"]),
        dependence=float(row.get("dependence", DEPENDENCE)),
    )


def _shape(row: Mapping[str, Any]) -> ShapeAnswer:
    """Return shape and size from a recording."""
    return ShapeAnswer(
        kind=str(row["kind"]),
        probability={str(row["kind"]): float(row["probability"])},
        size_m=float(row["size_m"]),
        low_m=float(row["low_m"]),
        high_m=float(row["high_m"]),
        dimensions_m=row.get("dimensions_m", {}),
        misfit=nan,
        thicknesses=tuple(Thickness(**one) for one in row["thicknesses"]),
    )


def _key_figures(scores: Mapping[str, ConfusionTable], story: _Story) -> tuple[KeyFigure, ...]:
    answers = story.answers
    if not answers:
        return (KeyFigure(value=str(len(story.taught)), caption="grasps taught"),)
    captions = [("right", "; 95 % interval {:.0%} to {:.0%}"), ("right with one grasp", "")]
    captions.append(("right by the paper's method", ", with one grasp"))
    figures = [
        KeyFigure(
            value=f"{score.accuracy:.0%}",
            caption=caption,
            note=f"{score.n_right} of {score.n}{note.format(*score.interval)}",
        )
        for score, (caption, note) in zip(scores.values(), captions, strict=False)
    ]
    if not figures:
        n_named = sum(one.label != UNKNOWN for one in answers)
        figures.append(KeyFigure(value=f"{n_named} of {len(answers)}", caption="with a name"))
    per_answer = np.mean([one.n_grasps for one in answers])
    return (*figures, KeyFigure(value=f"{per_answer:.1f}", caption="grasps until sure"))


def _line(tactile: TactileConfig) -> dict[str, str]:
    if tactile.serial_ports:
        return {"Sensor boards": tactile.place}
    can = f"{tactile.place}, {tactile.bitrate:,} bit/s"
    unit = tactile.sensor.canopen
    return {"CAN": f"{can}, node {tactile.node_id}" if unit else can}


def _facts(config: CellConfig | None, layout: TaxelLayout) -> tuple[tuple[str, str], ...]:
    sensor = {"Sensor": f"{layout.n_taxels} taxels on {layout.n_pads} pads"}
    if config is None:
        return tuple(sensor.items())
    sequence = config.sequence
    shown = {
        "Servos": ", ".join(f"{servo.model} (id {servo.id})" for servo in config.gripper.servos),
        "Servo bus": f"{config.gripper.port}, {config.gripper.baud_rate:,} baud",
        **sensor,
        **_line(config.tactile),
        "Force": f"{sequence.force_n[0]:g} to {sequence.force_n[1]:g} N",
        "Ramp": sequence.ramp.kind,
        "Position": f"x {sequence.x_mm[0]:g} to {sequence.x_mm[1]:g} mm, "
        f"y {sequence.y_mm[0]:g} to {sequence.y_mm[1]:g} mm",
        "Rotation": f"{sequence.rotation_deg[0]:g} to {sequence.rotation_deg[1]:g} deg",
        "Seed": str(config.seed),
    }
    if config.simulated:
        shown["Noise"] = f"{config.simulator.noise}, level {config.simulator.noise_level:g}"
    return tuple(shown.items())


def _health(recording: Recording) -> tuple[HealthGroup, ...]:
    """Return the values of the last loop message; counts only of links that the cell has."""
    if not recording.statistics:
        return ()
    last = recording.statistics[-1]
    groups = [
        health(last[name])
        for name, health in (("tactile", source_health), ("servo_bus", servo_health))
        if name in last
    ]
    if len(recording.cycles) > 1:
        period_s = float(np.median(np.diff(recording.cycles.t_s)))
        groups.append(loop_health(last, period_s))
    return tuple(groups)


def _remarks(recording: Recording) -> list[str]:
    """Return events that the operator should read with the results."""
    remarks = []
    if recording.lost_reason:
        remarks.append(f"The recording is not complete: {recording.lost_reason}.")
    kinds = [str(row["kind"]) for row in recording.events]
    if missed := kinds.count("no part"):
        remarks.append(f"{missed} grasps found no part.")
    shown = ("drift", "fault")
    remarks += [str(row["text"]) for row in recording.events if row["kind"] in shown]
    return list(dict.fromkeys(remarks))


def _notes(config: CellConfig | None, *, drawn: bool, baseline: bool) -> tuple[str, ...]:
    notes = []
    if drawn:
        notes.append("Poses and forces of the identifications differ from those of the teaching.")
    if baseline:
        opening = config is None or config.recognition.use_aperture
        notes.append(
            "The level check names the likeliest object by the taxels of one grasp, never UNKNOWN, "
            "as in the paper. The default recogniser uses the whole ramp, both pads"
            + (", the opening of the fingers" if opening else "")
            + " and several grasps."
        )
    if config is None:
        notes.append("The config in the recording is not valid in this version.")
    elif config.simulated:
        notes.append(
            "Simulated cell: rigid objects in 3 mm foam, servos and control unit with their real "
            "protocols. A real sensor drifts and wears; repeat the measurement on your cell."
        )
    return tuple(notes)


def _trajectories(
    recognizer: LevelCheckRecognizer | None, examples: Sequence[ShownGrasp]
) -> Trajectories | None:
    if recognizer is None:
        return None
    shown = {one.label: one.grasp for one in examples}
    objects = []
    for index, label in enumerate(recognizer.labels):
        grasp = shown.get(label)
        if grasp is None:
            continue
        try:
            swept = sweep(grip_surfaces(grasp)[0][np.newaxis]).value
        except (ContactError, QuadricError):
            swept = np.array([])
        objects.append(
            ObjectTrajectory(
                label=label,
                sweep=np.asarray(swept).ravel(),
                ramp_force_n=np.array(_RAMP_SHARES) * float(np.nanmax(grasp.force_n)),
                ramp_value=ramp_levels(grasp, _RAMP_SHARES),
                low=float(recognizer.low[index]),
                high=float(recognizer.high[index]),
            )
        )
    return Trajectories(
        objects=tuple(objects),
        windows=level_windows(recognizer.levels, recognizer.labels),
    )
