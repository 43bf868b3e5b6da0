"""The simulated cell as a process of its own, with a config that is ready for its ports."""

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from cell.config import CellConfig
from cell.config_changes import changed_config
from cell.config_file import config_text
from cell.config_writer import SCHEMA_LINE
from cell.dataset import read_dataset
from cell.errors import CellError, ConfigError
from cell.files import write_text
from cell.layouts import layout_from_pads
from cell.real_time import raised_priority
from cell.simulation import largest_aperture_m, simulator_settings
from recognition.grasp import Grasp
from simulator.errors import SimulatorError, SimulatorSettingsError
from simulator.process import serve

_OPENING_OVERSHOOT_M = 2e-3
"""Fingers that open run past their goal by up to so much; their records show it."""

_PATIENCE = (
    ("tactile", "heartbeat_ms", 400),
    ("gripper", "force_stale_ms", 300.0),
    ("gripper", "bus_loss_ms", 250.0),
    ("gripper", "watchdog_ms", 500.0),
    ("loop", "overruns_max", 40),
)
"""Section, key and least value of what a client on the same machine waits for."""


def serve_simulated_cell(
    config: CellConfig,
    *,
    frames: Path | None,
    folder: Path | None,
    announce: Callable[[dict[str, Any]], None],
    until_parent_ends: bool = False,
) -> None:
    """Serve until SIGTERM or SIGINT.

    Parameters
    ----------
    config
        The cell to simulate; its ports are replaced by the simulator's.
    frames
        Data set to play instead of pressing objects.
    folder
        Where device links, socket and config are made; a temporary folder by default.
    announce
        Gets device paths, and the path of the ready config as ``config``, when clients can come.
    until_parent_ends
        Also end when the process that started this one is gone.

    Raises
    ------
    CellError
        If terminals, socket or files cannot be made.
    """
    grasps: tuple[Grasp, ...] = read_dataset(frames) if frames is not None else ()
    layout = layout_from_pads(grasps[0].pads) if grasps else None
    reached_m = config.gripper.aperture_open_mm * 1e-3 + _OPENING_OVERSHOOT_M
    if grasps and largest_aperture_m(grasps) > reached_m:
        raise CellError(
            f"{frames} opens to {largest_aperture_m(grasps) * 1e3:.1f} mm, "
            f"gripper.aperture_open_mm is {config.gripper.aperture_open_mm:g}; "
            "take a config that opens further, as config/pinch-13x6.yaml"
        )
    settings = simulator_settings(config, layout=layout, grasps=grasps)
    with tempfile.TemporaryDirectory(prefix="tactile-cell-") as temporary:
        place = Path(temporary) if folder is None else folder.resolve()
        place.mkdir(parents=True, exist_ok=True)

        def announce_with_config(found: dict[str, Any]) -> None:
            path = place / "cell.yaml"
            text = config_text(_client_config(config, found), comments=False)
            write_text(path, text.removeprefix(SCHEMA_LINE), error=CellError, what="config")
            announce(found | {"config": str(path)})

        # The loop of a client may have real-time priority: devices that wait for a processor while
        # it does not would seem to be silent.
        try:
            with raised_priority(config.loop.priority - 1):
                serve(
                    settings,
                    announce_with_config,
                    folder=place,
                    until_parent_ends=until_parent_ends,
                )
        except SimulatorSettingsError as error:
            raise ConfigError(f"simulator: {error}") from error
        except SimulatorError as error:
            raise CellError(str(error)) from error


def _client_config(config: CellConfig, found: dict[str, Any]) -> CellConfig:
    """Return the config with which another process reaches the simulated cell."""
    # The simulated cell shares the processors with its client and with everything else: what a
    # device of its own answers in time may come late here, and is no fault.
    patience = {
        f"{section}.{key}": max(getattr(getattr(config, section), key), least)
        for section, key, least in _PATIENCE
    }
    ports = {
        "name": f"{config.name} on pseudo-terminals"[:80],
        "gripper.port": found["servo_port"],
        "tactile.interface": found["can_interface"],
        "tactile.channel": found["can_channel"],
        "simulator.faults": [],
        "positioner": {"kind": "simulated", "socket": found["positioner_socket"]},
    }
    return changed_config(config, ports | patience)
