"""The report of the main job: pressure felt, answers given, health of the links."""

from datetime import datetime
from pathlib import Path

import numpy as np

from cell.build import Cell
from cell.config.model import CellConfig
from cell.jobs.run import BASELINE, MainResult
from cell.learning.blas import one_blas_thread
from cell.report.build import (
    level_windows,
    loop_health,
    paper_table,
    servo_health,
    source_health,
)
from cell.report.data import (
    ConfusionTable,
    KeyFigure,
    ObjectTrajectory,
    ReportData,
    Trajectories,
)
from cell.report.page import write_report
from recognition.errors import ContactError, QuadricError
from recognition.quadric.level import grip_surfaces, ramp_levels
from recognition.quadric.trajectory import sweep
from recognition.recognizers.level_check import LevelCheckRecognizer

_RAMP_SHARES = tuple(np.linspace(0.2, 1.0, 9).tolist())
"""Shares of the grip force at which the eigenvalue along the ramp is drawn."""


def main_report(result: MainResult, config: CellConfig, cell: Cell, path: Path) -> Path:
    """Write the page and return its path. Raises cell.errors.ReportError."""
    write_report(path, report_data(result, config, cell))
    return path


@one_blas_thread()
def report_data(result: MainResult, config: CellConfig, cell: Cell) -> ReportData:
    """Return what the page shows of a run."""
    hand = cell.controller.hand
    statistics = hand.statistics
    return ReportData(
        title="What the cell held",
        subtitle=f"{config.name}: {result.n_taught} grasps taught, "
        f"{len(result.trials)} identifications",
        created=datetime.now().strftime("%Y-%m-%d %H:%M"),
        key_figures=_key_figures(result),
        facts=_facts(config, cell),
        layout=hand.layout,
        examples=tuple(result.examples.items()),
        trajectories=_trajectories(result),
        sequences=tuple((trial.truth, trial.found) for trial in result.trials),
        confusions=_confusions(result),
        health=(
            source_health(statistics.source),
            servo_health(statistics.servo_bus),
            loop_health(statistics.loop, hand.period_s),
        ),
        files=tuple(
            (name, str(file))
            for name, file in (
                ("Recording", result.recording),
                ("Data set", result.dataset),
                ("Model", result.model),
            )
            if file is not None
        ),
        notes=(*result.remarks, *_notes(config)),
    )


def _key_figures(result: MainResult) -> tuple[KeyFigure, ...]:
    low, high = result.scores[result.default].interval
    shown = {
        result.default: ("right", f"; 95 % interval {low:.0%} to {high:.0%}"),
        f"{result.default}_one_grasp": ("right with one grasp", ""),
    }
    shown.setdefault(BASELINE, ("right by the paper's method", ", with one grasp"))
    figures = [
        KeyFigure(
            value=f"{score.accuracy:.0%}",
            caption=caption,
            note=f"{score.n_right} of {score.n}{note}",
        )
        for name, (caption, note) in shown.items()
        if (score := result.scores.get(name)) is not None
    ]
    per_trial = np.mean([len(trial.found.records) for trial in result.trials])
    figures.append(KeyFigure(value=f"{per_trial:.1f}", caption="grasps until sure"))
    return tuple(figures)


def _facts(config: CellConfig, cell: Cell) -> tuple[tuple[str, str], ...]:
    sequence, layout = config.sequence, cell.controller.hand.layout
    shown = {
        "Servos": ", ".join(f"{servo.model} (id {servo.id})" for servo in config.gripper.servos),
        "Servo bus": f"{config.gripper.port}, {config.gripper.baud_rate:,} baud",
        "Sensor": f"{layout.n_taxels} taxels on {layout.n_pads} pads",
        "CAN": f"{config.tactile.interface} {config.tactile.channel}".strip()
        + f", {config.tactile.bitrate:,} bit/s, node {config.tactile.node_id}",
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


def _notes(config: CellConfig) -> tuple[str, ...]:
    notes = [
        "Poses and forces of the identifications were drawn anew; none was taught.",
        "The level check names the likeliest object by the taxels of one grasp, as in the paper, "
        "never UNKNOWN; the default recogniser uses the whole ramp, both pads"
        + (", the opening of the fingers" if config.recognition.use_aperture else "")
        + " and several grasps.",
    ]
    if config.simulated:
        notes.append(
            "Simulated cell: rigid objects in 3 mm foam, byte-true servos and control unit. "
            "A real sensor drifts and wears; measure on yours."
        )
    return tuple(notes)


def _trajectories(result: MainResult) -> Trajectories | None:
    recognizer = result.recognizers.get(BASELINE)
    if not isinstance(recognizer, LevelCheckRecognizer):
        return None
    objects = []
    for index, label in enumerate(recognizer.labels):
        record = result.examples.get(label)
        if record is None:
            continue
        try:
            swept = sweep(grip_surfaces(record.grasp)[0][np.newaxis]).value
        except (ContactError, QuadricError):
            swept = np.array([])
        force_n = float(np.nanmax(record.grasp.force_n))
        objects.append(
            ObjectTrajectory(
                label=label,
                sweep=np.asarray(swept).ravel(),
                ramp_force_n=np.array(_RAMP_SHARES) * force_n,
                ramp_value=ramp_levels(record.grasp, _RAMP_SHARES),
                low=float(recognizer.low[index]),
                high=float(recognizer.high[index]),
            )
        )
    return Trajectories(
        objects=tuple(objects),
        windows=level_windows(recognizer.levels, recognizer.labels),
    )


def _confusions(result: MainResult) -> tuple[ConfusionTable, ...]:
    paper = paper_table()
    tables = tuple(result.scores.values())
    return (paper, *tables) if set(paper.labels) == set(result.labels) else tables
