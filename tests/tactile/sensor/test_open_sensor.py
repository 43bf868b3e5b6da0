"""A sensor from its bus: what the block starts, whose bus it closes, and its force for a loop."""

from collections.abc import Iterator

import can
import pytest

from simulator import SimulatedCell, simulated_cell
from tactile import GripForce, TableCalibration, open_sensor, paper_layout, pinch_layout
from tactile.errors import CalibrationError, LinkStateError, NodeMissing


@pytest.fixture
def sim() -> Iterator[SimulatedCell]:
    with simulated_cell(layout=pinch_layout()) as cell:
        yield cell


@pytest.fixture
def opened(sim: SimulatedCell, monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, str, int]]:
    """Channels that are opened by name; the simulated bus stands behind each."""
    asked: list[tuple[str, str, int]] = []

    def open_bus(interface: str, channel: str, *, bitrate: int) -> can.BusABC:
        asked.append((interface, channel, bitrate))
        return sim.can_bus

    monkeypatch.setattr("tactile.sensor.opening.open_bus", open_bus)
    return asked


def is_open(bus: can.BusABC) -> bool:
    try:
        bus.recv(0.0)
    except can.CanOperationError:
        return False
    return True


@pytest.mark.slow
def test_the_block_starts_the_sensor_and_leaves_a_bus_that_it_was_given_open(sim) -> None:
    with open_sensor(sim.can_bus, pinch_layout()) as sensor:
        assert sensor.running
        assert sensor.tare().offset_counts.shape == (156,)
        assert sensor.read().finger_force_n == (0.0, 0.0)
    assert not sensor.running
    assert is_open(sim.can_bus)
    with pytest.raises(LinkStateError):
        sensor.read()
    with open_sensor(sim.can_bus, pinch_layout()) as sensor:
        assert sensor.tare_result is None


def test_a_bus_that_was_opened_by_name_is_closed_with_the_block(sim, opened) -> None:
    with open_sensor("can0", pinch_layout(), bitrate=500_000) as sensor:
        assert sensor.read().frame.counts.shape == (156,)
        assert is_open(sim.can_bus)
    assert opened == [("socketcan", "can0", 500_000)]
    assert not is_open(sim.can_bus)


def test_a_sensor_that_cannot_start_leaves_no_bus_open(sim, opened) -> None:
    sim.inject("unit.off")
    with pytest.raises(NodeMissing), open_sensor("can0", pinch_layout()):
        pass
    assert not is_open(sim.can_bus)
    sim.open_can_bus()
    with pytest.raises(CalibrationError, match="full scale of 4095 counts, layout paper has 255"):
        open_sensor("can0", paper_layout(), TableCalibration((1.0,), (0.01,), 4095))
    assert not is_open(sim.can_bus)


@pytest.mark.slow
def test_the_force_comes_in_whatever_its_reader_takes(sim) -> None:
    with open_sensor(sim.can_bus, pinch_layout()) as sensor:
        force = GripForce(sensor, dict)
        assert force.latest_force() is None
        sensor.tare()
        sensor.refresh()
        for _ in range(30):
            sim.clock.sleep(0.001)
            sample = force.latest_force()
        assert sample["force_n"] == (0.0, 0.0)
        assert sample["valid"]
        assert 0.0 < sample["noise_n"] < 1.0
        assert 1 <= len(force.take()) <= 2
        assert not force.take()
    assert force.latest_force() is None
