"""Plugins: what is built in, packages of others, names that clash, and modules that do not load."""

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from cell import plugins
from cell.config.file import changed_config, config_text, parse_config, schema_text
from cell.config.gripper import use_servo_models
from cell.config.model import CellConfig
from cell.config.tactile import layout_from_config
from cell.errors import CellError, ConfigError
from cell.files import PROGRAM
from cell.plugins import GROUPS, RECOGNIZERS, SENSORS, SERVO_MODELS
from gripper.dynamixel import models
from gripper.errors import LimitExceeded
from recognition.recognizers import RECOGNIZERS as BUILT_IN
from tactile.layout import inner_pads
from tests import blocks
from tests.cell.cells import call

Install = Callable[..., None]
MODULE = '''
from dataclasses import replace
from typing import Literal
from cell.config.sensor import SensorConfig
from gripper.dynamixel.models import XL330_M288

class Glove(SensorConfig):
    """A glove."""
    kind: Literal["glove"]
    fingers: int = 5

SERVO = replace(XL330_M288, name="XL330-M077", number=1190)
SAME = replace(XL330_M288, kt_nm_a=1.0)
'''


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Install]:
    """Return what installs a package whose module is MODULE."""
    monkeypatch.syspath_prepend(str(tmp_path))
    known = dict(models._MODELS)

    def add(name: str = "some-plugins", **entries: dict[str, str]) -> None:
        module = name.replace("-", "_")
        (tmp_path / f"{module}.py").write_text(MODULE)
        info = tmp_path / f"{module}-1.0.0.dist-info"
        info.mkdir()
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0.0\n")
        lines = [
            line
            for group, points in entries.items()
            for line in (
                f"[tactile_cell.{group}]",
                *(f"{key} = {module}:{one}" for key, one in points.items()),
            )
        ]
        (info / "entry_points.txt").write_text("\n".join(lines) + "\n")
        plugins._entries.cache_clear()

    yield add
    plugins._entries.cache_clear()
    models._MODELS.clear()
    models._MODELS.update(known)


def test_what_is_built_in_loads_and_no_table_beside_has_other_names() -> None:
    for group in GROUPS:
        examined = list(group.examine())
        assert examined
        for one in examined:
            assert (one.problem, one.package) == ("", PROGRAM)
            assert group.built_in(one.name)
    assert set(SERVO_MODELS) == set(models.MODELS)
    assert {name: RECOGNIZERS.entry(name).value for name in RECOGNIZERS} == BUILT_IN


def test_a_sensor_of_another_package_has_a_section_of_its_own(installed: Install) -> None:
    installed(sensors={"glove": "Glove"})
    text = "tactile:\n  sensor: {kind: glove, fingers: 4}\ngripper: {port: /dev/a}\n"
    config = parse_config(text + "positioner: {kind: operator}\n", source="cell.yaml")
    assert config.tactile.sensor.model_dump() == {"kind": "glove", "fingers": 4}
    assert parse_config(config_text(config), source="again") == config
    assert "fingers" in schema_text()
    with pytest.raises(ConfigError, match=r"cell.yaml:2:25: tactile.sensor.finger: .*mean fingers"):
        parse_config(text.replace("fingers", "finger"), source="cell.yaml")
    with pytest.raises(
        ConfigError, match=r"sensor glove cannot be simulated: set real ports in tactile\.sensor"
    ):
        config.tactile.sensor.simulated()


def test_an_unknown_kind_lists_what_is_installed_and_the_next_step() -> None:
    wanted = r"no sensor 'glove' is installed; installed are control_unit, flexitac, uskin. Install"
    with pytest.raises(ConfigError, match=wanted + ".*`tactile-cell doctor --plugins`"):
        changed_config(CellConfig(), {"tactile.sensor": {"kind": "glove"}})
    with pytest.raises(
        ConfigError, match="no servo model 'XM' is installed; installed are RH-P12-RN"
    ):
        changed_config(CellConfig(), {"gripper.servos": [{"id": 1, "model": "XM"}]})
    with pytest.raises(ConfigError, match="a section with kind, one of control_unit, flexitac"):
        changed_config(CellConfig(), {"tactile.sensor": {}})


def test_a_name_of_two_packages_is_refused(installed: Install) -> None:
    installed(sensors={"uskin": "Glove"})
    with pytest.raises(ConfigError, match=r"'uskin' is in .*some-plugins 1.0.0.*: uninstall one"):
        changed_config(CellConfig(), {"tactile.sensor": {"kind": "uskin"}})
    assert "uskin" not in SENSORS.usable()


@pytest.mark.parametrize(
    ("entry", "problem"),
    [
        ("Missing", "AttributeError"),
        ("SERVO", "TypeError: some_plugins:SERVO is not a SensorConfig"),
    ],
)
def test_doctor_names_what_does_not_load(installed: Install, entry: str, problem: str) -> None:
    installed(sensors={"broken": entry}, recognizers={"fine": "Glove"})
    with pytest.raises(CellError, match=r"1 of \d+ plugins do not load"):
        call("doctor", "--plugins")
    (one,) = (plugin for plugin in SENSORS.examine() if plugin.problem)
    assert (one.name, one.package) == ("broken", "some-plugins 1.0.0")
    assert problem in one.problem
    # What does not load is in the way of nothing else.
    assert "fine" in RECOGNIZERS
    assert CellConfig().tactile.sensor.kind == "control_unit"
    with pytest.raises(ConfigError, match=r"broken' of some-plugins 1.0.0 does not load: "):
        changed_config(CellConfig(), {"tactile.sensor": {"kind": "broken"}})


def test_doctor_lists_each_plugin_with_its_package(installed: Install) -> None:
    installed(sensors={"glove": "Glove"})
    lines = [line.split() for line in call("doctor", "--plugins").splitlines()]
    assert ["sensors", "glove", "some-plugins", "1.0.0", "loads"] in lines
    assert ["sensors", "uskin", *PROGRAM.split(), "loads"] in lines
    assert len(lines) == sum(len(list(group)) for group in GROUPS)


def test_a_servo_of_another_package_is_known_to_the_gripper(installed: Install) -> None:
    installed(servo_models={"XL330-M077": "SERVO", "XL330-again": "SAME"})
    servos = [{"id": n, "model": "XL330-M077"} for n in (1, 2)]
    changes = {"servos": servos, "current_max_a": 1.0}
    config = changed_config(CellConfig().gripper, changes)
    assert config.servos[0].model == "XL330-M077"
    assert models.model_name(1190) == "XL330-M077"
    with pytest.raises(LimitExceeded, match="XL330-M288 with number 1200 exists with other"):
        use_servo_models(["XL330-again"])


# -- The template package of docs/how-to/add.md; `.ci/wheel-test` types what that page prints ------


def test_the_layout_on_the_page_has_the_pads_of_the_sensor() -> None:
    (block,) = (
        one for one in blocks("how-to/add.md", "yaml") if one.startswith("tactile:\n  layout:")
    )
    layout = layout_from_config(parse_config(block, source="page").tactile)
    assert layout.name == "dfrobot_6x6"
    assert layout == inner_pads("dfrobot_6x6", 6, 6, 3e-3, adc_max=4095)
