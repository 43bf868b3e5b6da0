"""`dbc`: writes the cell's CAN traffic as a DBC file."""

from cell.interfaces.cli.options import ConfigOption, TextOutOption


def dbc(config: ConfigOption = None, output: TextOutOption = None) -> None:
    """Write the cell's CAN traffic as a DBC file.

    For cantools, SavvyCAN, CANalyzer and others. Needs the extra `dbc`.
    """
    from cell.config.tactile import layout_from_config
    from cell.installation import extra
    from cell.interfaces.cli.session import cell_config
    from cell.interfaces.cli.terminal import print_or_write

    with extra("dbc", needed_by="a DBC file"):
        from tactile.unit.dbc import dbc_text

    tactile = cell_config(config).tactile
    text = dbc_text(
        layout_from_config(tactile),
        node_id=tactile.node_id,
        sync_period_ms=round(tactile.sync_period_ms),
        heartbeat_ms=round(tactile.heartbeat_ms),
        force_period_ms=tactile.force_period_ms,
    )
    print_or_write(text, output, "DBC file")
