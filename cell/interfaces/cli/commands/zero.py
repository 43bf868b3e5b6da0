"""`zero`: closes the empty fingers on each other and measures zero, gains and foam."""

from typing import Any

from cell.interfaces.cli.options import ConfigOption, JsonOption, OutOption


def zero(
    config: ConfigOption = None, out_folder: OutOption = None, json_file: JsonOption = None
) -> None:
    """Close the empty fingers on each other: zero of the opening, gains of the pads, foam.

    Later commands of this cell use the result. First remove everything between the fingers.
    """
    from cell.interfaces.cli.session import cell_config, running_cell
    from cell.interfaces.cli.terminal import print_line, print_note
    from cell.runtime.goals import ZeroGoal

    checked = cell_config(config)
    if checked.self_zero in ("always", "daily"):
        # Measured once: by this command, not at the start too.
        checked = checked.model_copy(update={"self_zero": "on_demand"})
    found: dict[str, Any] = {}
    with running_cell(checked, "zero", out_folder, config_file=config, json_file=json_file) as cell:
        cell.run(ZeroGoal(), lambda job: found.update(job.progress))
        if zero_note := cell.plugin.health()["zero"]["text"]:
            print_note(zero_note)
    print_line(found["text"])
    if (moved_mm := found["zero"]["moved_mm"]) is not None:
        print_line(f"{moved_mm:+.2f} mm since the last measurement")
    cell.finish(found["zero"])
