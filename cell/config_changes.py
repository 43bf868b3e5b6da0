"""A config with some values changed."""

import json
from collections.abc import Mapping
from typing import Any

from pydantic import ValidationError

from cell.config import CellConfig
from cell.errors import ConfigError


def changed_config(config: CellConfig, changes: Mapping[str, Any]) -> CellConfig:
    """Return a config with some values changed.

    Parameters
    ----------
    config
        The config.
    changes
        New values by dotted path, as ``{"tactile.tare_frames": 25}``.

    Raises
    ------
    ConfigError
        If there is no such value, or the result is no valid config.
    """
    values = config.model_dump(mode="json")
    for path, value in changes.items():
        owner: Any = values
        *way, last = path.split(".")
        for name in way:
            owner = owner.get(name) if isinstance(owner, dict) else None
        if not isinstance(owner, dict) or last not in owner:
            raise ConfigError(f"the config has no value {path!r}")
        owner[last] = value
    try:
        return CellConfig.model_validate_json(json.dumps(values))
    except ValidationError as error:
        complaints = "; ".join(
            f"{'.'.join(map(str, item['loc'])) or 'config'}: {item['msg']}"
            for item in error.errors(include_url=False)
        )
        raise ConfigError(f"the changed config is not valid: {complaints}") from error
