"""Rows 31 to 42: the host, its files, its commands."""

from benchmarks.fault_campaign.row import FaultRow

ROWS: tuple[FaultRow, ...] = ()
