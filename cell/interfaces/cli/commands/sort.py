"""`sort`: identifies parts and releases each at its place."""

from collections.abc import Iterator
from typing import Annotated, Any

import typer
from rich.table import Table

from cell.control.part import Part
from cell.errors import ConfigError
from cell.interfaces.cli import options
from cell.interfaces.cli.session import cell_config, model_of_folder, pads_of, running_cell
from cell.interfaces.cli.terminal import plain_text, print_note, show
from cell.learning.model import load_model
from cell.runtime.goals import FEED_MAX, TAUGHT_GRASPS, SortGoal
from cell.runtime.main_job import teach_objects
from cell.runtime.tasks import Places, simulated_feed


def sort(
    config: options.Config = None,
    parts: Annotated[
        int, typer.Option("--parts", min=1, max=1_000_000, metavar="N", help="Number of parts.")
    ] = 20,
    teach_grasps: Annotated[
        int | None,
        options.taught_grasps(
            "Teach so many grasps of each simulated object, without the model of this folder "
            f"[default: {TAUGHT_GRASPS} if there is no model]."
        ),
    ] = None,
    model: options.FolderModel = None,
    out_folder: options.Out = None,
    seed: options.Seed = None,
    faults: options.Faults = None,
    json_file: options.Json = None,
) -> None:
    """Identify parts and release each at its place."""
    checked = cell_config(config, seed=seed, faults=faults)
    simulated = checked.brings_objects
    if teach_grasps is None or not simulated:
        model = model_of_folder(model)
    teach_grasps = teach_grasps or TAUGHT_GRASPS
    if model is None and not simulated:
        raise ConfigError("--model is missing; `tactile-cell teach` and `model train` make one")
    objects = [entry.label for entry in checked.simulator.objects]
    Places(checked, objects if model is None else load_model(model, pads_of(checked)).labels)
    feed = simulated_feed(checked, min(parts, FEED_MAX)) if simulated else ()
    goal = SortGoal(parts=parts, feed=tuple(feed), seed=checked.seed + 1)
    tally: dict[str, Any] = {}
    each: list[Part] = []
    try:
        with running_cell(
            *(checked, "sort", out_folder), config_file=config, json_file=json_file, model=model
        ) as cell:
            if model is None:
                print_note(
                    f"no --model: first teaches {teach_grasps} grasps each of "
                    f"{', '.join(objects)}, about half a second each"
                )
                teach_objects(cell.plugin, checked, objects, teach_grasps, cell.progress)
                cell.plugin.train()
            cell.plugin.watch_parts(
                lambda part, identification: each.append(part) if identification else None
            )
            answer = cell.run(goal, lambda job: tally.update(job.progress))
    finally:
        show(tally_lines(tally))
    cell.finish((), answer.as_json() | {"parts": each})


def tally_lines(tally: dict[str, Any]) -> Iterator[str | Table]:
    """Yield the number of parts at each place, and the wrong ones, from the progress of a sort."""
    if not tally.get("n_parts"):
        yield "no part was sorted"
        return
    table = Table(header_style="bold")
    table.add_column("part")
    for place in tally["places"]:
        table.add_column(plain_text(place), justify="right")
    for truth, counts in tally["matrix"].items():
        table.add_row(
            plain_text(truth), *(str(count) if count else "" for count in counts.values())
        )
    table.add_row("all", *(str(count) for count in tally["places"].values()), style="bold")
    yield table
    missed = f", {tally['n_missed']} times no part was found" if tally["n_missed"] else ""
    yield (
        f"{tally['n_parts']} parts sorted, {100 * tally['share_named']:.0f} % with a name, "
        f"{tally['n_rejected']} rejected{missed}"
    )
    if tally["matrix"]:
        wrong = ", ".join(
            f"part {part['number']}, {part['was']} to {part['place']}" for part in tally["mistakes"]
        )
        yield f"mistakes: {wrong or 'none'}"
