"""Load of the bus by a control unit, against tables and against the simulated wire."""

from dataclasses import replace

import pytest

from simulator.can.wire import mean_bits
from tactile.control_unit.bus_load import bus_load, least_sync_period_s, message_bits
from tactile.control_unit.settings import LinkSettings
from tactile.layout import paper_layout

QUIET = LinkSettings(force_period_s=0.0, heartbeat_s=10.0)


@pytest.mark.parametrize(("n_bytes", "bits"), [(0, 55), (4, 95), (8, 135)])
def test_a_message_has_the_bits_of_the_standard_at_most(n_bytes: int, bits: int) -> None:
    assert message_bits(n_bytes) == bits
    assert mean_bits(bytes(n_bytes)) <= bits


@pytest.mark.parametrize(
    ("period_s", "bitrate", "share"),
    [(0.01, 1_000_000, 0.80), (0.02, 1_000_000, 0.40), (0.02, 500_000, 0.80)],
)
def test_the_frames_of_408_taxels_load_the_bus(period_s: float, bitrate: int, share: float) -> None:
    settings = replace(QUIET, sync_period_s=period_s)
    assert bus_load(paper_layout(), settings, bitrate) == pytest.approx(share, abs=0.005)


def test_force_messages_alone_may_be_too_many() -> None:
    settings = LinkSettings(force_period_s=0.001)
    assert least_sync_period_s(paper_layout(), settings, 125_000) == float("inf")
