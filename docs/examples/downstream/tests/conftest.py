"""What the tests of the station share: a taught recognizer. All else comes from tactile-cell."""

import pytest


@pytest.fixture
def station_cell(simulated_cell):
    """Return the station's cell, simulated and started."""
    return simulated_cell(seed=7).start()


@pytest.fixture
def recognizer(station_cell):
    """Teach two of the station's parts; the third stays unknown."""
    return station_cell.teach(["dowel", "bearing"], grasps=20)
