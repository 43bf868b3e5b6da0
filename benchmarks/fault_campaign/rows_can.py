"""Rows 1 to 17: the CAN link, the control unit, the taxels."""

from benchmarks.fault_campaign import rows_can_frames, rows_can_node
from benchmarks.fault_campaign.row import FaultRow

ROWS: tuple[FaultRow, ...] = (*rows_can_frames.ROWS, *rows_can_node.ROWS)
