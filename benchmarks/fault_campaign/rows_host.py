"""Rows 31 to 42: the host, its files, its commands."""

from benchmarks.fault_campaign import (
    rows_host_commands,
    rows_host_disk,
    rows_host_inputs,
    rows_host_loop,
    rows_host_processes,
    rows_host_time,
)
from benchmarks.fault_campaign.row import FaultRow

ROWS: tuple[FaultRow, ...] = (
    *rows_host_loop.ROWS,
    *rows_host_time.ROWS,
    *rows_host_disk.ROWS,
    *rows_host_inputs.ROWS,
    *rows_host_commands.ROWS,
    *rows_host_processes.ROWS,
)
