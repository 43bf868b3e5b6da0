"""Rows 18 to 30: the servo bus, the servos, the part."""

from benchmarks.fault_campaign.row import FaultRow
from benchmarks.fault_campaign.rows_servo_bus import BUS_ROWS
from benchmarks.fault_campaign.rows_servo_grip import GRIP_ROWS
from benchmarks.fault_campaign.rows_servo_state import STATE_ROWS

ROWS: tuple[FaultRow, ...] = (*BUS_ROWS, *STATE_ROWS, *GRIP_ROWS)
