"""The hand of a config: what its mechanics change in the settings of its sensor."""

from cell.config.model import CellConfig
from cell.config.tactile import TactileConfig
from cell.hand.build import sensor_settings


def test_friction_that_holds_a_force_is_no_frozen_sensor() -> None:
    usual = sensor_settings(TactileConfig(), CellConfig().friction_n).quality
    assert 1.0 < usual.force_step_n < 1.5
    # 3.6 N were seen where empty pads met.
    assert sensor_settings(TactileConfig(), 14.0).quality.force_step_n > 4.0
    assert sensor_settings(TactileConfig(), 1.0).quality.force_step_n == 1.0
