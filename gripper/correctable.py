"""Which registers a start may rewrite by itself."""

CORRECTABLE = frozenset(
    {"return_delay_time", "operating_mode", "status_return_level", "position_p_gain"}
)
"""Registers that a start may rewrite: none changes mechanics or protection of a servo."""
