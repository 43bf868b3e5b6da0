"""The ends of the range of each key: the cell works there, or the config is refused by that key."""

from collections.abc import Iterator
from contextlib import nullcontext
from typing import Any

import pytest
from annotated_types import Ge, Gt, Le, Lt
from pydantic import BaseModel

from cell.build import build_cell
from cell.config.file import changed_config
from cell.config.model import CellConfig
from cell.control.plan import GraspStep, Pose
from cell.errors import ConfigError
from cell.simulation import simulation_of
from gripper.mechanics.kinematics import end_transmissions
from tests.faults.campaign import campaign_config
from tests.marks import LONG

_ELSEWHERE = ("serve.", "positioner.", "sort.", "recognition.", "loop.", "seed", "host_timeout_s")
"""Keys of no effect on a grasp in virtual time; their ends are still read."""
_MINUTES = ("sequence.ramp.hold_s=60",)
"""Ends that do nothing but let time pass."""
_BOUND_S = 60.0
"""Longest simulated time of a start and a grasp in s."""
_BESIDE: dict[str, dict[str, Any]] = {
    "gripper.aperture_open_mm=2": {
        "simulator.objects": [{"label": "ball", "shape": "box:length=20mm,width=10mm,height=1.5mm"}]
    },
    "sequence.ramp.rate_n_s=0.1": {"sequence.force_n": [1.0, 1.5]},
    "simulator.noise_level=2.5": {"gripper.contact_force_n": 1.5, "tactile.tare_frames": 50},
}
"""What an end needs beside it: because of the object, the short tare, or the time of a ramp."""
_USUAL = CellConfig()
_NEEDED_A = max(
    path.loading_current_a(max(_USUAL.sequence.forces_n))
    for path in end_transmissions(_USUAL.gripper_settings, _USUAL.linkage)
)
REFUSED = {
    "gripper.linkage.link_mm=5": "aperture_open_mm is beyond gripper.linkage, its lengths",
    "gripper.linkage.link_mm=500": "lower the force or shorten the lever of the linkage",
    "gripper.aperture_open_mm=400": "aperture_open_mm is beyond gripper.linkage",
    "gripper.aperture_min_mm=400": "aperture_min_mm 400 must be below aperture_open_mm 16",
    "gripper.contact_force_n=5": "gripper.contact_force_n = 5 N to hold a part",
    "gripper.contact_timeout_s=1": "contact_timeout_s is 1, but from aperture_open_mm = 16",
    "gripper.force_max_n=1": "ramp asks for 8.0 N, the limit is 0.70 N",
    "gripper.current_max_a=0.05": f"8.0 N take {_NEEDED_A:.3f} A, current_max_a is 0.05 A",
    "sequence.carry_force_n=0.1": "carry_force_n is 0.1 N; it must be at least",
    "sequence.carry_force_n=50": "ramp asks for 50.0 N, the limit is 13.64 N",
}
"""Ends that the defaults of other keys forbid, and what is said of them."""


class TooLong(BaseException):
    """A start and a grasp took more simulated time than allowed; nothing catches it."""


def ends(section: BaseModel, path: str = "") -> Iterator[tuple[str, float]]:
    """Return the lowest and the highest value of each number; just inside of what is excluded."""
    for name, key in type(section).model_fields.items():
        value, here = getattr(section, name), f"{path}{name}"
        if isinstance(value, BaseModel):
            yield from ends(value, f"{here}.")
        for bound in key.metadata:
            if isinstance(bound, Ge | Le):
                limit: Any = bound.ge if isinstance(bound, Ge) else bound.le
                yield here, limit
            elif isinstance(bound, Gt | Lt):
                yield here, bound.gt + 1e-6 if isinstance(bound, Gt) else bound.lt - 1e-6


ENDS = {f"{path}={value:g}": {path: value} for path, value in ends(_USUAL)}
"""Change of the config by the name of each end."""


def config_at(end: str) -> CellConfig:
    """Return a config with short jobs and a key at its end; ConfigError where it is refused."""
    return campaign_config({"gripper.aperture_open_mm": 16.0} | _BESIDE.get(end, {}) | ENDS[end])


def grasp(end: str) -> None:
    """Start, bring the ball and grasp it with a key at its end; raises what goes wrong."""
    config = config_at(end)
    with simulation_of(config) as simulated:
        cell = build_cell(config, simulated=simulated)

        def look(now_s: float) -> None:
            if now_s > _BOUND_S:
                raise TooLong

        simulated.clock.on_advance.append(look)
        try:
            cell.controller.start()
            cell.controller.moves.present("ball")
            cell.controller.grasp(GraspStep(pose=Pose(), force_n=config.sequence.forces_n[0]))
        finally:
            simulated.clock.on_advance.remove(look)
            cell.close()


GRASPED = tuple(
    end for end in ENDS if not end.startswith(_ELSEWHERE) and end not in (*_MINUTES, *REFUSED)
)
"""Accepted ends that matter for a grasp."""


@pytest.mark.slow
def test_all_ends_are_accepted_but_those_that_others_forbid() -> None:
    complaints = dict(REFUSED)
    for end in ENDS:
        complaint = complaints.pop(end, "")
        with pytest.raises(ConfigError, match=complaint) if complaint else nullcontext():
            config = config_at(end)
            if end.startswith("simulator."):
                simulation_of(config).close()
    assert complaints == {}


@pytest.mark.slow
@pytest.mark.parametrize("end", [GRASPED[0], *map(LONG, GRASPED[1:])])
def test_a_grasp_is_done_at_the_end(end) -> None:
    grasp(end)


@pytest.mark.parametrize(("bitrate", "period_ms"), [(250_000, 43), (500_000, 20), (1_000_000, 10)])
def test_each_frame_is_through_in_the_shortest_period_of_a_bit_rate(bitrate, period_ms) -> None:
    keys = {"self_zero": "never", "tactile.bitrate": bitrate, "tactile.tare_frames": 50}
    with pytest.raises(ConfigError, match=f"tactile.sync_period_ms {period_ms} or more"):
        changed_config(CellConfig(), keys | {"tactile.sync_period_ms": period_ms - 1.0})
    config = changed_config(CellConfig(), keys | {"tactile.sync_period_ms": float(period_ms)})
    cell = build_cell(config)
    try:
        cell.controller.start()
        assert cell.controller.hand.statistics.source.frames.lost == 0
    finally:
        cell.close()
