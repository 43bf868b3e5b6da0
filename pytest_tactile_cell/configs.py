"""The config of a test: from a file, with changes by options or by the test."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from cell.config.file import changed_config, load_config
from cell.config.model import CellConfig
from cell.config.section import SIMULATED
from cell.errors import ConfigError


def simulated_config(
    config: CellConfig | Path | str,
    *,
    objects: Mapping[str, str] | None = None,
    seed: int | None = None,
    changes: Mapping[str, Any] | None = None,
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

    Raises
    ------
    ConfigError
        If the result is not valid, or a change is of a value that is replaced.
    """
    if not isinstance(config, CellConfig):
        config = load_config(Path(config))
    ours: dict[str, Any] = {
        "gripper.port": SIMULATED,
        "tactile.interface": SIMULATED,
        "tactile.channel": "",
        "positioner": {"kind": "simulated"},
    }
    if config.tactile.serial_ports:
        ours["tactile.sensor.ports"] = [SIMULATED] * len(config.tactile.serial_ports)
    if objects is not None:
        ours["simulator.objects"] = [
            {"label": label, "shape": shape} for label, shape in objects.items()
        ]
    if seed is not None:
        ours["seed"] = seed
    for path in changes or ():
        if any(f"{path}.".startswith(f"{key}.") for key in ours):
            raise ConfigError(f"changes cannot set {path}: the fixture has set it")
    zeroed = {"self_zero": "on_demand"} if config.self_zero == "daily" else {}
    return changed_config(config, {**zeroed, **(changes or {}), **ours})
