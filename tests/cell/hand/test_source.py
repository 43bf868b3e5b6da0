"""A cell on a frame source that is no control unit: nothing above the source depends on CAN."""

from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from cell.build import build_cell
from cell.data.dataset import read_grasps
from cell.jobs.collection import grasps_of
from cell.simulation import simulation_of
from simulator.cell import SimulatedCell
from tactile.errors import LinkFault
from tactile.layout import TaxelLayout
from tactile.source import (
    Arrivals,
    FrameSource,
    FrameStatistics,
    PadZero,
    SourceIdentity,
    SourceStatistics,
    TactileFrame,
)
from tests.cell.conftest import small_config

PERIOD_S = 0.02


class BareSource:
    """Frames of a simulated world without a bus, counter, checksum, serial number or forces."""

    sends_forces = False

    def __init__(self, cell: SimulatedCell) -> None:
        self.layout: TaxelLayout = cell.settings.layout
        self._cell = cell
        self._frames = FrameStatistics()
        self._due_s: float | None = None
        self.unplugged = False

    @property
    def statistics(self) -> SourceStatistics:
        return SourceStatistics(frames=self._frames)

    def start(self) -> SourceIdentity:
        self._due_s = self._cell.clock.monotonic()
        return SourceIdentity(name="bare")

    def poll(self) -> Arrivals:
        if self.unplugged:
            raise LinkFault("the sensor is unplugged: plug it in")
        now_s = self._cell.clock.monotonic()
        if self._due_s is None or now_s < self._due_s:
            return Arrivals()
        self._due_s += PERIOD_S
        self._frames.complete += 1
        counts = self._cell.devices.physical.scan()
        return Arrivals(
            (TactileFrame(t_s=now_s, counter=self._frames.complete, status=0, counts=counts),)
        )

    def set_zero(self, zero: PadZero) -> None:
        raise AssertionError("it sends no force messages")

    def stop(self) -> None:
        self._due_s = None


def test_a_cell_grasps_records_and_faults_on_a_source_without_can(tmp_path: Path) -> None:
    config = small_config(gripper__approach_speed_mm_s=12.0)
    with simulation_of(config) as simulated:
        simulated.can_bus.shutdown()
        simulated.devices.faults.can.unplugged = True
        source: FrameSource = (bare := BareSource(simulated))
        cell = build_cell(config, folder=tmp_path, simulated=simulated, source=source)
        with closing(cell):
            cell.controller.start()
            (grasp,) = grasps_of(cell.controller, config.sequence, ["ball"], 1)
            assert grasp.force_n[-1] > 3.0
            assert cell.health()["tactile"]["complete"] > 50
            bare.unplugged = True
            simulated.clock.sleep(0.1)
            with pytest.raises(LinkFault, match="unplugged"):
                cell.idle()
            assert "unplugged" in (cell.controller.life.fault or "")
    (kept,) = read_grasps(tmp_path / "recording.mcap")
    np.testing.assert_array_equal(kept.counts, grasp.counts)
