"""The config of a test: from a file, with changes by options or by the test."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from cell.config.file import changed_config, load_config
from cell.config.model import CellConfig
from cell.config.section import SIMULATED
from pytest_tactile_cell.options import HardwareOptions


def config_under_test(path: Path | None, options: HardwareOptions) -> CellConfig:
    """Return the config of the file with the command line's values for servos and node.

    Raises
    ------
    ConfigError
        If the file or the result is not valid.
    """
    config = load_config(path)
    changes: dict[str, Any] = {}
    if options.servo_baud_rate is not None:
        changes["gripper.baud_rate"] = options.servo_baud_rate
    if options.servo_ids is not None:
        known = {servo.id: servo.model_dump(mode="json") for servo in config.gripper.servos}
        changes["gripper.servos"] = [known.get(i, {"id": i}) for i in options.servo_ids]
    if options.can_bitrate is not None:
        changes["tactile.bitrate"] = options.can_bitrate
    if options.node_id is not None:
        changes["tactile.node_id"] = options.node_id
    return changed_config(config, changes)


def simulated_config(
    config: CellConfig | Path | str,
    *,
    objects: Mapping[str, str] | None = None,
    seed: int | None = None,
    changes: Mapping[str, Any] | None = None,
    callback: bool = False,
) -> CellConfig:
    """Return a config with simulated ports; other values stay.

    Only ``self_zero: daily`` becomes ``on_demand``: a test zeroes only on request.

    Parameters
    ----------
    config
        The config or its file, of a real cell or a simulated one.
    objects
        Shapes by label instead of the config's objects.
    seed
        Seed instead of the config's.
    changes
        Further values by dotted path.
    callback
        Whether a mover of the test moves the object; else the simulated cell places it.

    Raises
    ------
    ConfigError
        If the result is not valid.
    """
    if not isinstance(config, CellConfig):
        config = load_config(Path(config))
    ours: dict[str, Any] = {
        "gripper.port": SIMULATED,
        "tactile.interface": SIMULATED,
        "tactile.channel": "",
        "positioner": {"kind": "callback" if callback else "simulated"},
    }
    if config.tactile.serial_ports:
        ours["tactile.sensor.ports"] = [SIMULATED] * len(config.tactile.serial_ports)
    if objects is not None:
        ours["simulator.objects"] = [
            {"label": label, "shape": shape} for label, shape in objects.items()
        ]
    if seed is not None:
        ours["seed"] = seed
    zeroed = {"self_zero": "on_demand"} if config.self_zero == "daily" else {}
    return changed_config(config, {**zeroed, **(changes or {}), **ours})
