"""`zero`: closes the empty fingers on each other and measures what has changed in the hand."""

from cell.interfaces.cli.options import ConfigOption, JsonOption, OutOption


def zero(
    config: ConfigOption = None, out_folder: OutOption = None, json_file: JsonOption = None
) -> None:
    """Close the empty fingers on each other: zero of the opening, gains of the pads, foam.

    Later commands on this cell use it. Take everything out of the grip first.
    """
    from cell.control.self_zero import zero_text, zero_values
    from cell.interfaces.cli.session import cell_config, running_cell
    from cell.interfaces.cli.terminal import print_line, print_note, write_json

    checked = cell_config(config)
    if checked.self_zero in ("always", "daily"):
        # It is measured once: here, not at the start too.
        checked = checked.model_copy(update={"self_zero": "on_demand"})
    with running_cell(checked, "zero", out_folder, config_file=config, json_file=json_file) as (
        cell,
        _,
    ):
        before = cell.controller.self_zero
        found = cell.controller.measure_zero()
        moved_mm = None if before is None else 1e3 * (found.zero.opening_m - before.opening_m)
        if cell.controller.zero_note:
            print_note(cell.controller.zero_note)
    print_line(zero_text(found))
    if moved_mm is not None:
        print_line(f"{moved_mm:+.2f} mm since the last one")
    write_json(json_file, zero_values(found.zero) | {"moved_mm": moved_mm})
    cell.check_recording()
