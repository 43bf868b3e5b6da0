"""What the config says of slips, heat and too much force is what the gripper goes by."""

from cell.config.file import parse_config
from cell.config.gripper import GripperConfig
from cell.config.model import CellConfig
from gripper.settings import GripperSettings, OverForce, ServoSettings

TEXT = """
gripper:
  open_speed_mm_s: 50.0
  bus_loss_ms: 80.0
  stall_max_ms: 300.0
  contact: {samples: 5, approach_force_n: 1.5}
  settle: {timeout_s: 0.7, tolerance_n: 0.2, tolerance_share: 0.05}
  slip:
    {drop_n: 0.9, drop_share: 0.2, travel_mm: 2.0, slide_mm: 3.0,
     runaway_mm_s: 30.0, runaway_mm: 0.7}
  imbalance: {difference_n: 3.0, difference_share: 0.4, time_s: 0.3}
  over_force: {reaction: limp, noise_n: 0.4, left_share: 0.3, open_mm: 1.0}
  servo_care:
    derate_c: 12.0
    taper_after_s: 2.0
    taper_n_s: 0.5
    corrected_registers: [operating_mode]
"""


def test_every_key_reaches_the_gripper() -> None:
    settings = parse_config(TEXT, source="cell.yaml").gripper_settings
    assert settings.open_speed_m_s == 0.05
    assert settings.bus_loss_s == 0.08
    assert settings.stall_max_s == 0.3
    assert (settings.contact_samples, settings.approach_force_n) == (5, 1.5)
    assert settings.settle_timeout_s == 0.7
    assert (settings.settle_tolerance_n, settings.settle_tolerance_share) == (0.2, 0.05)
    assert (settings.slip_drop_n, settings.slip_drop_share, settings.slip_travel_m) == (
        *(0.9, 0.2),
        0.002,
    )
    assert (settings.runaway_speed_m_s, settings.runaway_travel_m) == (0.03, 0.0007)
    assert settings.slide_m == 0.003
    assert (settings.imbalance_n, settings.imbalance_share, settings.imbalance_s) == (3.0, 0.4, 0.3)
    assert settings.over_force is OverForce.LIMP
    assert (settings.force_noise_n, settings.over_force_share) == (0.4, 0.3)
    assert settings.over_force_open_m == 0.001
    assert settings.temperature_derate_k == 12.0
    assert (settings.taper_after_s, settings.force_loop.taper_n_s) == (2.0, 0.5)
    assert settings.corrected_registers == {"operating_mode"}


def test_the_defaults_of_the_config_are_those_of_the_gripper() -> None:
    found = CellConfig().gripper_settings
    plain = GripperSettings(servos=(ServoSettings(servo_id=1), ServoSettings(servo_id=2)))
    for name in (
        *("open_speed_m_s", "approach_force_n", "contact_samples", "settle_timeout_s"),
        *("settle_tolerance_n", "settle_tolerance_share", "slip_drop_n", "slip_drop_share"),
        *("slip_travel_m", "slide_m", "runaway_speed_m_s", "runaway_travel_m", "imbalance_n"),
        *("imbalance_share", "imbalance_s", "over_force", "force_noise_n", "over_force_share"),
        *("over_force_open_m", "temperature_derate_k", "taper_after_s", "corrected_registers"),
        *("force_loop", "stall_max_s"),
    ):
        assert getattr(found, name) == getattr(plain, name), name
    assert abs(found.bus_loss_s - plain.bus_loss_s) < 1e-12
    assert GripperConfig().over_force.reaction == "lower"
