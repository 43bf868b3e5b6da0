"""The fault campaign: every row of the table of faults on the simulated cell.

``python -m benchmarks fault_campaign`` runs all rows and the state machine and writes
docs/fault-campaign.md.
"""

from benchmarks.fault_campaign.row import FaultRow, Observed
from benchmarks.fault_campaign.rows import ROWS

__all__ = ["ROWS", "FaultRow", "Observed", "main"]


def main() -> None:
    """Run all of it and write the page."""
    from benchmarks.fault_campaign import page

    page.main()
