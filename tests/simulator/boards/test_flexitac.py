"""The simulated FlexiTac board: a foreign reader on its terminal, and the physics of its pads."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import flexitac
import numpy as np
import pytest

from simulator.boards import resistive
from simulator.boards.flexitac import FlexiTacSettings
from simulator.can.faults import ControlUnitFaults
from simulator.cell import SimulatedCell
from simulator.clock import VirtualClock
from simulator.realtime.terminals import BoardPty
from simulator.settings import SimulatorSettings
from tactile.flexitac import PROFILES, FlexiTacBoard
from tactile.layout import LAYOUTS

LAYOUT = LAYOUTS["flexitac_12x32"]()


@contextmanager
def simulated(name: str = "flexitac_12x32", **changes: Any) -> Iterator[SimulatedCell]:
    layout = LAYOUTS[name]()
    pad = layout.pads[0]
    boards = FlexiTacSettings(rows=pad.columns, columns=pad.rows)
    with SimulatedCell(SimulatorSettings(layout=layout, boards=boards, **changes)) as cell:
        yield cell


@pytest.mark.parametrize("profile", sorted(PROFILES))
def test_the_foreign_package_and_our_reader_agree_frame_by_frame(profile, tmp_path) -> None:
    with simulated(f"flexitac_{profile}") as cell:
        board, clock = cell.devices.boards[1], cell.clock
        cell.world.press(1, 0.004, 0.002, 3.0)  # type: ignore[union-attr]
        pty, size = BoardPty(board, tmp_path / "board1"), PROFILES[profile]
        # Virtual time goes on only while the foreign reader waits for bytes.
        stop = threading.Event()

        def serve() -> None:
            while not stop.is_set():
                clock.sleep(0.002)
                pty.poll(clock.monotonic())
                stop.wait(0.0005)

        reader = flexitac.FlexiTacSensor(
            pty.path, rows=size.rows, cols=size.columns, baseline=20.0, read_timeout_s=30.0
        )
        # It takes the first marker that it finds: its stream has to begin with a frame.
        clock.sleep(0.05)
        board.drop_pending()
        thread = threading.Thread(target=serve, daemon=True)
        with reader:
            thread.start()
            theirs = [reader.read().raw for _ in range(20)]
            stop.set()
            thread.join()
        pty.close()
        assert theirs[-1].max() > 60
        assert theirs[-1].shape == (size.rows, size.columns)
        stream, ours = FlexiTacBoard(0, size, rows_along=False), []
        for _ in range(60):
            clock.sleep(0.005)
            ours += stream.feed(board.transmit(clock.monotonic()), clock.monotonic())
        mine = np.mean([np.frombuffer(samples, np.uint8) for _, samples in ours], axis=0)
        np.testing.assert_allclose(mine, np.mean(theirs, axis=0).ravel(), atol=1.5)


@pytest.fixture
def world() -> Any:
    """A world with forces on taxels."""
    force_n = np.zeros(LAYOUT.n_taxels)
    return SimpleNamespace(force_n=force_n, measured_force_n=lambda: force_n)


@pytest.fixture
def board(world: Any, monkeypatch: pytest.MonkeyPatch) -> resistive.ResistivePads:
    """Pads without noise that read 80 of 1,023 at rest."""
    monkeypatch.setattr(resistive, "_NOISE_COUNTS", 0.0)
    monkeypatch.setattr(resistive, "_REST_COUNTS", (80.0, 80.0))
    return resistive.ResistivePads(world, LAYOUT, ControlUnitFaults())


def test_a_press_shows_in_its_row_and_column_as_well(world, board) -> None:
    world.force_n[5 * 12 + 3] = 3.0
    change = board.scan()[:384].reshape(32, 12).astype(int) - 20
    assert change[5, 3] == change.max() > 100
    assert change[5, 9] > 2
    assert change[20, 3] > 0
    assert change[20, 9] == 0


def test_the_law_is_compressive_and_a_falling_force_shows_more_than_a_rising(world, board) -> None:
    counts = []
    for force_n in (1.0, 2.0, 4.0, 1.0, 0.0, 40.0):
        world.force_n[100] = force_n
        counts.append(int(board.scan()[100]) - 20)
    assert counts[1] - counts[0] < counts[0]
    assert counts[3] > counts[0] + 2
    assert counts[4:] == [0, 255 - 20]


def test_the_clock_needs_no_reader() -> None:
    clock = VirtualClock()
    with SimulatedCell(SimulatorSettings(layout=LAYOUT, boards=FlexiTacSettings()), clock) as cell:
        clock.sleep(3.0)
        assert 65000 < len(cell.devices.boards[0].transmit(clock.monotonic())) <= 65536
