"""`sort`: names parts, keeps each, and lets it go at its place."""

from typing import TYPE_CHECKING, Annotated

import typer

from cell.interfaces.cli.options import (
    ConfigOption,
    FaultOption,
    JsonOption,
    ModelOption,
    OutOption,
    SeedOption,
)

if TYPE_CHECKING:
    from cell.jobs.sort import Tally


def sort(
    config: ConfigOption = None,
    parts: Annotated[int, typer.Option("--parts", min=1, max=1_000_000, help="Parts.")] = 20,
    teach_grasps: Annotated[
        int,
        typer.Option(
            "--teach",
            min=3,
            max=1000,
            help="Grasps taught of each object of the simulated cell, without a model.",
        ),
    ] = 20,
    model: ModelOption = None,
    out_folder: OutOption = None,
    seed: SeedOption = None,
    faults: FaultOption = None,
    json_file: JsonOption = None,
) -> None:
    """Name parts and let each go at its place."""
    from cell.errors import ConfigError
    from cell.interfaces.cli.session import cell_config, pads_of, running_cell
    from cell.interfaces.cli.terminal import write_json
    from cell.jobs.run import teach_objects
    from cell.jobs.sort import Places, Tally, simulated_feed, sort_parts
    from cell.learning.model import load_model
    from cell.learning.taught_model import TaughtModel

    checked = cell_config(config, seed=seed, faults=faults)
    simulated = checked.brings_objects
    if model is None and not simulated:
        raise ConfigError("--model is missing; `tactile-cell teach` and `train` make one")
    taught = TaughtModel(checked, None if model is None else load_model(model, pads_of(checked)))
    objects = [entry.label for entry in checked.simulator.objects]
    tally = Tally(places=Places(checked, objects if model is None else taught.labels))
    feed = simulated_feed(checked, parts) if simulated else None
    try:
        with running_cell(checked, "sort", out_folder, config_file=config, json_file=json_file) as (
            cell,
            progress,
        ):
            if model is None:
                teach_objects(cell, checked, taught, objects, teach_grasps, progress=progress)
                taught.train()
            sort_parts(
                cell.controller,
                taught,
                tally,
                n_parts=parts,
                feed=lambda turn: None if feed is None else feed[turn],
                seed=checked.seed + 1,
                on_part=lambda part, _found: progress("sort", part.number, parts),
            )
    finally:
        print_tally(tally)
    made = {"recording": cell.recording_path, "health": cell.health()}
    write_json(json_file, tally.as_json() | made)
    cell.check_recording()


def print_tally(tally: "Tally") -> None:
    """Print how many parts lie where, and which of them do not belong there."""
    from rich.table import Table

    from cell.interfaces.cli.terminal import plain_text, print_line, print_table

    if not tally.parts:
        print_line("no part was sorted")
        return
    table = Table(header_style="bold")
    table.add_column("part")
    for place in tally.places.names:
        table.add_column(plain_text(place), justify="right")
    for truth, counts in tally.matrix().items():
        table.add_row(
            plain_text(truth), *(str(count) if count else "" for count in counts.values())
        )
    table.add_row("all", *(str(count) for count in tally.counts.values()), style="bold")
    print_table(table)
    missed = f", {tally.n_missed} times no part was found" if tally.n_missed else ""
    print_line(
        f"{len(tally.parts)} parts sorted, {100 * tally.share_named:.0f} % with a name, "
        f"{tally.n_rejected} rejected{missed}"
    )
    if tally.matrix():
        wrong = ", ".join(
            f"part {part.number}, {part.truth} to {part.place}" for part in tally.mistakes
        )
        print_line(f"mistakes: {wrong or 'none'}")
