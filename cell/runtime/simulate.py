"""Serving the simulated cell to other processes, with a config for its ports."""

import tempfile
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from cell.config.file import SCHEMA_LINE, changed_config, config_text
from cell.config.model import CellConfig
from cell.config.positioner import PositionerConfig
from cell.errors import CellError, ConfigError, raised_as
from cell.files import alone_in, write_text
from cell.hand.real_time import raised_priority
from cell.learning.parallel import one_blas_thread
from cell.simulation import simulator_settings
from simulator.errors import SimulatorError, SimulatorSettingsError
from simulator.realtime.process import serve

_LEAST_LIMITS = (
    ("tactile", "heartbeat_ms", 400),
    ("tactile", "silence_ms", 200.0),
    ("tactile", "loss_max_share", 0.5),
    ("gripper", "force_stale_ms", 300.0),
    ("gripper", "bus_loss_ms", 250.0),
    ("gripper", "feedback_loss_max_share", 0.5),
    ("gripper", "watchdog_ms", 500.0),
    ("loop", "overruns_max", 40),
)
"""Section, key and least value (ms, share, or periods) of a client's limits. Cell and client share
the processors of one machine, and an answer that is late for this reason is no fault."""
_LEAST_AXIS_LOSS_MS = 400.0
"""Least time in ms after which a client reports a drive or servo of an axis as lost."""


@one_blas_thread()
def serve_simulated_cell(
    config: CellConfig,
    *,
    folder: Path | None,
    announce: Callable[[dict[str, Any]], None],
    until_parent_ends: bool = False,
) -> None:
    """Serve until SIGTERM or SIGINT.

    Raises CellError if terminals, socket or files cannot be made.

    Parameters
    ----------
    config
        The cell to simulate. The simulator's ports replace its ports, and the simulator's socket
        its positioner, unless axes move the object.
    folder
        Folder of device links, socket and config; a temporary folder by default.
    announce
        Gets the device paths, and the path of the config as ``config``, when clients can connect.
    until_parent_ends
        Also end when the parent process ends.
    """
    settings = simulator_settings(config)
    with ExitStack() as undo:
        temporary = undo.enter_context(tempfile.TemporaryDirectory(prefix="tactile-cell-"))
        place = Path(temporary) if folder is None else folder.resolve()
        with raised_as(CellError, OSError, where="name another folder with --out"):
            (lock := place / ".running").mkdir(parents=True, exist_ok=True)
        # The links of its devices belong to one cell.
        running = f"another simulated cell is running in {place}: end it, or choose another folder "
        undo.enter_context(alone_in(lock, CellError(f"{running}with --out")))

        def announce_with_config(announced: dict[str, Any]) -> None:
            path = place / "cell.yaml"
            text = config_text(client_config(config, announced), comments=False)
            write_text(path, text.removeprefix(SCHEMA_LINE), error=CellError, what="config")
            announce(announced | {"config": str(path)})

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


def client_config(config: CellConfig, announced: dict[str, Any]) -> CellConfig:
    """Return the config with which another process reaches the simulated cell.

    ``announced``: values of the cell; see `simulator.realtime.process.serve`.
    """
    timeouts = {
        f"{section}.{key}": max(getattr(getattr(config, section), key), least)
        for section, key, least in _LEAST_LIMITS
    }
    ports = {
        "name": f"{config.name} on pseudo-terminals"[:80],
        "gripper.port": announced["servo_port"],
        "tactile.interface": announced["can_interface"],
        "tactile.channel": announced["can_channel"],
        "simulator.faults": [],
        "positioner": _client_positioner(config.positioner, announced),
    }
    if config.tactile.serial_ports:
        ports["tactile.sensor"] = config.tactile.sensor.model_dump() | {
            "ports": announced["board_ports"]
        }
    return changed_config(config, ports | timeouts)


def _client_positioner(config: PositionerConfig, announced: dict[str, Any]) -> dict[str, Any]:
    """Return the positioner for a client: the axes of the config, else the simulated cell."""
    socket = {"socket": announced["positioner_socket"]}
    if config.kind != "axes":
        return {"kind": "simulated"} | socket
    values = config.model_dump(mode="json") | socket
    if config.drives:
        loss_ms = max(config.can.heartbeat_loss_ms, _LEAST_AXIS_LOSS_MS)
        channel = {
            "interface": announced["can_interface"],
            "channel": announced["axes_can_channel"],
        }
        values["can"] |= channel | {"heartbeat_loss_ms": loss_ms}
    for axis in values["axes"]:
        if axis["moves"] in announced["axes_ports"]:
            axis["port"] = announced["axes_ports"][axis["moves"]]
            axis["bus_loss_ms"] = max(axis["bus_loss_ms"], _LEAST_AXIS_LOSS_MS)
    return values
