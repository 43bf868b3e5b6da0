"""Rows 33 and 34, and 31 where it takes processes: signals, kills, a host that hogs its lock."""

from benchmarks.fault_campaign.row import FaultRow

ROWS: tuple[FaultRow, ...] = ()
