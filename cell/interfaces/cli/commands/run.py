"""`run`: the main job, teaches objects and identifies each of them."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated

import typer
from rich.table import Table

from cell.config.model import CellConfig
from cell.errors import CellError, ConfigError, MissingExtraError, RecordingError, ReportError
from cell.installation import missing_note
from cell.interfaces.cli import options
from cell.interfaces.cli.session import cell_config, running_cell
from cell.interfaces.cli.terminal import percent, plain_text, print_note
from cell.recording.reader import read_recording
from cell.report.confusion import TABLE_1, TABLE_1_LABELS, ConfusionTable, paper_table
from cell.report.page import write_report
from cell.report.recorded import recorded_report
from cell.report.shapes import shapes_view
from cell.runtime.goals import TAUGHT_GRASPS
from cell.runtime.main_job import MainResult, teach_and_identify
from cell.simulation import true_sizes
from recognition.recognizer import UNKNOWN

ObjectsOption = Annotated[
    list[str] | None,
    typer.Option("--object", metavar="NAME", help="Object; repeat for several [default: all]."),
]


def run(
    config: options.Config = None,
    objects: ObjectsOption = None,
    teach_grasps: Annotated[
        int, options.taught_grasps("Number of grasps to teach for each object.")
    ] = TAUGHT_GRASPS,
    trials: Annotated[
        int, typer.Option("--trials", min=1, max=1000, metavar="N", help="Trials of each object.")
    ] = 10,
    out_folder: options.Out = None,
    seed: options.Seed = None,
    faults: options.Faults = None,
    json_file: options.Json = None,
) -> None:
    """Teach objects and identify each of them: the main job."""
    checked = cell_config(config, seed=seed, faults=faults)
    labels = _labels(checked, objects)
    no_report = missing_note("report", "report page")
    failed: CellError | None = None
    with running_cell(checked, "run", out_folder, config_file=config, json_file=json_file) as cell:
        folder = cell.folder
        result = teach_and_identify(
            cell.plugin,
            checked,
            labels=labels,
            n_teach=teach_grasps,
            n_trials=trials,
            folder=folder,
            progress=cell.progress,
        )
    if not no_report:
        assert result.recording is not None
        try:
            page = folder / "report.html"
            write_report(page, recorded_report(read_recording(result.recording)))
            result.report = page
        except (RecordingError, ReportError, MissingExtraError) as error:
            failed = error
    lines = [*result_lines(result, true_sizes(checked))]
    if no_report:
        print_note(no_report)
    cell.finish(lines, result.as_json())
    if failed is not None:
        raise failed


def _labels(config: CellConfig, objects: Sequence[str] | None) -> list[str]:
    """Return the objects of a run. Raises ConfigError if the cell does not have them."""
    if not config.brings_objects:
        if not objects:
            raise ConfigError("name the available objects, for example --object ball --object box")
        return list(objects)
    configured = [entry.label for entry in config.simulator.objects]
    labels = list(objects or configured)
    strange = [label for label in labels if label not in configured]
    if strange:
        raise ConfigError(
            f"the simulated cell has no object {', '.join(strange)}; it has {', '.join(configured)}"
        )
    return labels


def result_lines(result: MainResult, true_sizes: Mapping[str, str]) -> Iterator[str | Table]:
    """Yield confusion tables, shapes, times and files of a run, and the paper's table.

    ``true_sizes`` are those of simulated objects, texts by label.
    """
    if set(result.labels) == set(TABLE_1_LABELS):
        order = [TABLE_1_LABELS.index(label) for label in result.labels]
        paper = paper_table()
        right = f"{paper.n_right} of {paper.n} right"
        axes = "Rows: part held; columns: answer, in per cent"
        yield f"The paper's own cell (its Table 1): {right}. {axes}"
        rows = [[TABLE_1[row][column] for column in order] for row in order]
        yield confusion_table(result.labels, rows)
    same: dict[bytes, list[ConfusionTable]] = {}
    for counted in result.scores.values():
        same.setdefault(counted.counts.tobytes(), []).append(counted)
    for alike in same.values():
        for counted in alike:
            accuracy = percent(counted.accuracy, counted.interval)
            yield f"{counted.name}: {counted.text}; {accuracy}, in brackets the 95 % interval"
        yield confusion_table(result.labels, alike[0].counts.tolist())
    yield f"One grasp takes {result.grasp_s:.1f} s of the cell's time."
    yield from result.remarks
    shapes = shapes_view(
        [(part.presented, part.label, part.shape) for part in result.parts], true_sizes
    )
    for group in [] if shapes is None else shapes["groups"]:
        sizes = f"; {group['text']}" if group["text"] else ""
        yield f"measured shape of {group['label']}: {group['kinds']}{sizes}"
    files = {"report": result.report, "recording": result.recording, "model": result.model}
    for name, path in files.items():
        if path is not None:
            yield f"{name + ':':<10} {path}"
    yield f"Teaching and identification took {result.seconds:.0f} s."


def confusion_table(labels: Sequence[str], confusion: Sequence[Sequence[float]]) -> Table:
    """Return a confusion table: a row for each held object, a column for each answer."""
    columns = [*labels, UNKNOWN] if len(confusion[0]) > len(labels) else list(labels)
    table = Table(header_style="bold")
    table.add_column("part")
    for column in columns:
        table.add_column(plain_text(column), justify="right")
    for row, (label, counts) in enumerate(zip(labels, confusion, strict=True)):
        table.add_row(
            plain_text(label),
            *(
                f"[bold green]{value:g}[/]"
                if place == row
                else f"[red]{value:g}[/]"
                if value
                else "[dim]0[/]"
                for place, value in enumerate(counts)
            ),
        )
    return table
