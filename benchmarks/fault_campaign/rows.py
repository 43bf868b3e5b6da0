"""All rows of the campaign."""

from benchmarks.fault_campaign import rows_can, rows_host, rows_servo
from benchmarks.fault_campaign.row import FaultRow

ROWS: tuple[FaultRow, ...] = tuple(
    sorted(
        (*rows_can.ROWS, *rows_servo.ROWS, *rows_host.ROWS),
        key=lambda row: (row.row, row.variant),
    )
)
