"""The impact of closing fingers, and the closing speed that the cap of the force allows."""

import re
from contextlib import suppress
from dataclasses import replace
from typing import Any

import pytest

from cell.config.file import changed_config
from cell.config.model import CellConfig
from gripper.errors import ForceAboveCap, LimitExceeded
from gripper.force.approach import approach
from gripper.force.ramp import ForceRamp
from gripper.mechanics.impact import approach_speed_m_s, check_approach, impact_limit
from gripper.mechanics.kinematics import ParallelLinkage
from gripper.mechanics.transmission import Mechanics
from gripper.servos.goal_limits import GoalWriter
from gripper.settings import GripperSettings
from tests.values import measured_drives

LINKAGE = ParallelLinkage(link_m=0.06)
SETTINGS = GripperSettings()


def mechanics(linkage: ParallelLinkage = LINKAGE, **changes: Any) -> Mechanics:
    return Mechanics(replace(SETTINGS, **changes), linkage, measured_drives(SETTINGS))


def test_the_default_speed_is_below_what_the_default_cap_allows() -> None:
    assert check_approach(mechanics()) == SETTINGS.approach_speed_m_s
    assert approach_speed_m_s(mechanics(), (0.1, 0.1)) == SETTINGS.approach_speed_m_s
    limit = impact_limit(mechanics())
    # 0.0062 kg m² at 60 mm are 1.7 kg, on 55 N/mm 311 N for each m/s; a tenth of 15 N stays free.
    assert limit.momentum_n_s_m == pytest.approx(311.0, abs=6.0)
    assert limit.most_n == pytest.approx(13.5)
    assert limit.pad_speed_m_s() == pytest.approx(0.038, abs=0.001)
    assert limit.pad_speed_m_s(10.0) == pytest.approx(0.0112, abs=0.0003)
    assert limit.pad_speed_m_s(14.0) == 0.0


@pytest.mark.parametrize(
    ("change", "linkage", "faster"),
    [
        ({"force_max_n": 8.0}, LINKAGE, False),
        ({"pad_stiffness_n_m": 20e3}, LINKAGE, True),
        ({"approach_force_n": 4.0}, LINKAGE, False),
        ({}, ParallelLinkage(link_m=0.03), False),
        ({}, ParallelLinkage(link_m=0.09), True),
    ],
)
def test_mass_stiffness_lever_and_current_set_the_speed(change, linkage, faster) -> None:
    plain = impact_limit(mechanics()).pad_speed_m_s()
    assert (impact_limit(mechanics(linkage, **change)).pad_speed_m_s() > plain) is faster


def test_a_cap_below_which_nothing_stops_is_refused_and_the_remedy_works() -> None:
    with pytest.raises(LimitExceeded, match=r"force_max_n is 2 N: .* Raise") as error:
        check_approach(mechanics(force_max_n=2.0))
    remedy = re.search(r"Raise force_max_n to ([0-9.]+) N", str(error.value))
    assert check_approach(mechanics(force_max_n=float(remedy[1]))) >= 0.004


def test_a_config_is_slowed_with_the_reason() -> None:
    assert CellConfig().notes == ()
    unmeasured = {"self_zero": "never", "sequence.carry_force_n": 12.0}
    assert "stay at 9.4 N of 12 N" in changed_config(CellConfig(), unmeasured).notes[0]
    (note,) = changed_config(CellConfig(), {"gripper.approach_speed_mm_s": 150.0}).notes
    assert re.match(r"the fingers approach with as little as 7\d\.\d mm/s, not with gripper", note)
    rack = {"kind": "rack_pinion", "pinion_radius_mm": 8.0}
    short = {"gripper.linkage": rack, "gripper.force_max_n": 30.0}
    friction, *_ = changed_config(CellConfig(), short).notes
    assert "the servos' friction is 11 N at the pads" in friction


def test_the_limit_stands_beside_the_write_and_not_in_the_caller_alone(
    make_started, monkeypatch
) -> None:
    monkeypatch.setattr(
        approach, "approach_speed_m_s", lambda one, *_a, **_k: one.settings.approach_speed_m_s
    )
    hard = {"stiffness_n_m": 55e3, "force_max_n": 12.0, "current_max_a": 0.8}

    def peak_n() -> float:
        cell = make_started(aperture_m=0.03, approach_speed_m_s=0.1, approach_force_n=1.0, **hard)
        with suppress(ForceAboveCap):
            cell.gripper.grasp(ForceRamp.linear(4.0, rate_n_s=10.0))
        return cell.peak_n

    assert peak_n() < 12.0
    monkeypatch.setattr(GoalWriter, "bounded", lambda _self, goals, _state, **_k: tuple(goals))
    assert peak_n() > 12.0, "the speed that is asked for passes no cap: nothing is shown"


def test_a_new_drive_counts_at_once_and_equal_angles_are_computed_once() -> None:
    own, angles_rad = Mechanics(GripperSettings(), LINKAGE), (0.1, 0.1)
    paths, limit = own.transmissions(angles_rad), impact_limit(own, angles_rad)
    assert own.transmissions(list(angles_rad)) is paths
    assert impact_limit(own, angles_rad) is limit
    heavy = replace(paths[0].drive, breakaway_a=0.2, kt_nm_a=0.5 * paths[0].drive.kt_nm_a)
    own.drives.put(1, heavy)
    assert [path.drive for path in own.transmissions(angles_rad)] == [heavy, paths[1].drive]
    assert impact_limit(own, angles_rad).mass_kg > 1.5 * limit.mass_kg
    capped = own.with_settings(replace(own.settings, force_max_n=9.0))
    assert capped.drives is own.drives
    assert impact_limit(capped, angles_rad).most_n == pytest.approx(8.1)
