"""Contract of each kind of `tactile.sensor`, tested on its simulated device."""

import pickle
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial

import numpy as np
import pytest
from pydantic import ValidationError

from cell.config.file import changed_config
from cell.config.model import CellConfig
from cell.config.sensor import SensorConfig, SensorLines
from cell.config.tactile import layout_from_config
from cell.hand.local import frame_source
from cell.plugins import SENSORS
from cell.simulation import open_can_bus, simulation_of
from pytest_tactile_cell.configs import simulated_config
from simulator.cell import SimulatedCell
from tactile.errors import LinkFault, LinkStateError
from tactile.source import FrameSource, TactileFrame

PERIOD_S = 0.005
"""Period of the force loop."""
PATIENCE_S = 3.0
"""Longest time in s until a lost line becomes a fault."""
RATE_SHARE = 0.3
"""Allowed deviation of the frame rate from the usual rate, as a share."""
PRESS_N = 5.0
"""Force of a fingertip in N; its middle may be 1.5 taxels from the highest count."""


@pytest.fixture
def config(plugin_name: str, cell_config: CellConfig) -> CellConfig:
    """Return the config under test if it has this sensor, else a config with its defaults."""
    if cell_config.tactile.sensor.kind == plugin_name:
        return simulated_config(cell_config)
    section: type[SensorConfig] = SENSORS[plugin_name]
    layout = changed_config(CellConfig().tactile, {"layout": section.layout})
    changes = {
        "tactile.sensor": {"kind": plugin_name},
        "tactile.layout": section.layout,
        "tactile.calibration": {
            "counts": [layout_from_config(layout).adc_max],
            "force_n": [PRESS_N],
        },
        "gripper.force_stale_ms": 1e3 * max(0.06, 2.5 * section.period_s),
    }
    return simulated_config(changed_config(CellConfig(), changes))


@contextmanager
def started(
    config: CellConfig, *, start: bool = True
) -> Iterator[tuple[SimulatedCell, FrameSource]]:
    """Create the simulated device and its source."""
    with simulation_of(config) as cell:
        n_lines = range(len(cell.board_streams))
        lines = SensorLines(
            clock=cell.clock,
            open_serial=[partial(cell.open_board, n) for n in n_lines],
            can_bus=cell.can_bus,
            reopen_can=partial(open_can_bus, cell),
        )
        source = frame_source(config.tactile, lines)
        if start:
            source.start()
        yield cell, source
        source.stop()


def run(cell: SimulatedCell, source: FrameSource, seconds: float) -> list[TactileFrame]:
    """Poll like the force loop; return the frames."""
    frames: list[TactileFrame] = []
    end_s = cell.clock.monotonic() + seconds
    while cell.clock.monotonic() < end_s:
        cell.clock.sleep(PERIOD_S)
        frames += source.poll().frames
    return frames


def test_its_section_is_checked_and_goes_to_other_processes(plugin_name: str) -> None:
    section: type[SensorConfig] = SENSORS[plugin_name]
    value = section.model_validate({"kind": plugin_name})
    assert section.model_validate_json(value.model_dump_json()) == value
    assert pickle.loads(pickle.dumps(value)) == value
    with pytest.raises(ValidationError):
        section.model_validate({"kind": plugin_name, "no_such_key": 1})


@pytest.mark.slow
def test_a_config_loads_no_driver_of_it(plugin_name: str) -> None:
    code = (
        "import sys; from cell.plugins import SENSORS; "
        f"SENSORS[{plugin_name!r}](kind={plugin_name!r}); "
        "print(*{'can', 'canopen', 'simulator'} & set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == ""


def test_frames_are_whole_new_and_dated(config: CellConfig) -> None:
    with started(config) as (cell, source):
        run(cell, source, 0.2)
        frames, n_taxels = run(cell, source, 1.0), source.layout.n_taxels
        period_s = config.tactile.frame_period_s
        assert len(frames) * period_s == pytest.approx(1.0, rel=RATE_SHARE)
        times_s = [frame.t_s for frame in frames]
        assert times_s == sorted(set(times_s))
        assert all(frame.scanned_s <= frame.t_s <= cell.clock.monotonic() for frame in frames)
        assert {(f.counts.shape, f.counts.dtype.name) for f in frames} == {((n_taxels,), "uint16")}
        assert not any(frame.counts.flags.writeable for frame in frames)
        assert max(int(frame.counts.max()) for frame in frames) <= source.layout.adc_max
        steps = np.diff([frame.counter for frame in frames]) % (1 << 16)
        assert set(steps.tolist()) == {1}
        assert source.statistics.frames.complete >= len(frames)
        assert source.statistics.recent_loss_rate == 0.0


def test_a_poll_does_not_wait(config: CellConfig) -> None:
    with started(config) as (cell, source):
        now_s = cell.clock.monotonic()
        source.poll()
        assert cell.clock.monotonic() == now_s
        assert not source.poll().frames


def test_a_press_shows_at_its_place(config: CellConfig) -> None:
    with started(config) as (cell, source):
        layout = source.layout
        rest = np.mean([frame.counts for frame in run(cell, source, 0.5)], axis=0)
        for pad in layout.gripping_pads:
            taxels, shape = layout.taxels_of(pad), layout.pads[pad]
            places_m = layout.taxel_xy_m[taxels]
            # Towards one corner: no mirrored or transposed pad shows it there.
            wanted_m = 0.5 * places_m[0] + np.array([0.0, 0.1 * shape.pitch_y_m])
            cell.devices.world.press(pad, float(wanted_m[0]), float(wanted_m[1]), PRESS_N)
            change = run(cell, source, 0.3)[-1].counts - rest
            highest = int(np.argmax(change))
            assert highest in range(layout.n_taxels)[taxels]
            off_m = np.abs(layout.taxel_xy_m[highest] - wanted_m)
            assert np.all(off_m <= 1.5 * np.array([shape.pitch_x_m, shape.pitch_y_m]))
            cell.devices.world.lift()
            run(cell, source, 0.5)


def test_a_lost_line_is_a_fault_of_each_call_until_a_new_start(config: CellConfig) -> None:
    name = "can.unplugged" if config.tactile.sensor.on_can else "board.unplugged=0"
    with started(config) as (cell, source):
        fault = cell.inject(name)
        with pytest.raises(LinkFault) as first:
            run(cell, source, PATIENCE_S)
        with pytest.raises(type(first.value)) as second:
            source.poll()
        assert str(second.value) == str(first.value)
        source.stop()
        fault.clear()
        source.start()
        assert run(cell, source, 0.2)


def test_a_line_that_is_out_is_a_fault_of_the_start(config: CellConfig) -> None:
    name = "can.unplugged" if config.tactile.sensor.on_can else "board.unplugged=0"
    with started(config, start=False) as (cell, source):
        cell.inject(name)
        with pytest.raises(LinkFault):
            source.start()


def test_it_reads_between_start_and_stop_alone(config: CellConfig) -> None:
    with started(config, start=False) as (cell, source):
        with pytest.raises(LinkStateError):
            source.poll()
        source.start()
        assert run(cell, source, 0.2)
        source.stop()
        source.stop()
        with pytest.raises(LinkStateError):
            source.poll()
        source.start()
        assert run(cell, source, 0.2)
