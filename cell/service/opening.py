"""Opening a service and the cell behind it."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from cell.build import kept_folder
from cell.config.model import CellConfig
from cell.runtime.plugin import TactileCellPlugin
from cell.service.history import history_file
from cell.service.pose_handshake import PoseHandshake
from cell.service.service import Service
from gripper.clock import Clock


def open_service(
    config: CellConfig,
    *,
    note: Callable[[str], None] = lambda _text: None,
    clock: Clock = time,
    wall_s: Callable[[], float] = time.time,
    **cell: Any,
) -> Service:
    """Open a cell and return its service.

    Parameters
    ----------
    config
        The cell. A positioner of kind ``callback`` is the pose handshake. ``host_timeout_s`` has no
        effect, because the lease supervises the clients.
    note, clock, wall_s
        As `Service`.
    cell
        Model, folder of the recording and other arguments of `TactileCellPlugin`.

    Raises
    ------
    As `TactileCellPlugin`.
    """
    poses = PoseHandshake()
    plugin = TactileCellPlugin(
        config.model_copy(update={"host_timeout_s": None}),
        mover=poses.move if config.positioner.kind == "callback" else None,
        note=note,
        wall_s=wall_s,
        **cell,
    )
    kept = kept_folder(config, cell.get("folder"))
    beside = cell.get("save") or cell.get("model")
    return Service(
        plugin,
        config,
        poses=poses,
        history_file=None if kept is None else history_file(kept, config.name),
        photos_beside=None if beside is None else Path(beside),
        note=note,
        clock=clock,
        wall_s=wall_s,
    )
