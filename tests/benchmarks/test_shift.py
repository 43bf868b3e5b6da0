"""A short shift: its parts are sorted, its clients are served, no file and no thread is left."""

import pytest

from benchmarks.performance.shift import condensed
from tests.benchmarks.test_soak import quick_config


@pytest.mark.long
@pytest.mark.no_cover
@pytest.mark.timeout(600)
def test_a_shift_of_six_minutes_is_sorted_before_the_eyes_of_its_clients() -> None:
    samples, messages, ledger = condensed(0.1, quick_config())
    assert samples[-1].done == ledger["parts"] + ledger["missed"] == 12
    assert ledger["faults"] == 0
    assert all(messages)
    assert messages[3] < messages[0]
    assert samples[-1].descriptors <= samples[1].descriptors
    assert samples[-1].threads <= samples[1].threads + 1
