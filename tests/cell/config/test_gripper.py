"""What the config says of the gripper is what the gripper goes by, key by key."""

from collections.abc import Iterator
from typing import Any

import pytest
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from cell.config.file import changed_config
from cell.config.model import CellConfig
from cell.config.section import Declared
from gripper.settings import ForceLoopSettings, GripperSettings, OverForce


def declared(section: BaseModel, path: str) -> Iterator[tuple[str, FieldInfo, Declared]]:
    """Return each key below a path that stands for a setting of the gripper."""
    for name, key in type(section).model_fields.items():
        value, here = getattr(section, name), f"{path}.{name}"
        if isinstance(value, BaseModel):
            yield from declared(value, here)
        yield from ((here, key, link) for link in key.metadata if isinstance(link, Declared))


KEYS = [*declared(CellConfig().gripper, "gripper"), *declared(CellConfig().loop, "loop")]


def of_gripper(config: CellConfig, link: Declared) -> Any:
    settings = config.gripper_settings
    return getattr(settings.force_loop if link.owner is ForceLoopSettings else settings, link.name)


@pytest.mark.parametrize(("path", "key", "link"), KEYS, ids=[path for path, _, _ in KEYS])
def test_a_key_has_the_default_of_its_setting_and_reaches_it(path, key, link) -> None:
    plain = link.owner()
    assert of_gripper(CellConfig(), link) == pytest.approx(getattr(plain, link.name))
    other = key.default + 1 if isinstance(key.default, int) else 0.98 * key.default
    changed = changed_config(CellConfig(), {path: other})
    assert of_gripper(changed, link) == pytest.approx(other * link.unit)


def test_keys_without_a_number_reach_the_gripper() -> None:
    changes = {
        "gripper.over_force.reaction": "limp",
        "gripper.servo_care.corrected_registers": ["operating_mode"],
    }
    settings = changed_config(CellConfig(), changes).gripper_settings
    assert settings.over_force is OverForce.LIMP
    assert settings.corrected_registers == {"operating_mode"}
    plain, own = CellConfig().gripper_settings, GripperSettings()
    assert plain.over_force is own.over_force
    assert plain.corrected_registers == own.corrected_registers
