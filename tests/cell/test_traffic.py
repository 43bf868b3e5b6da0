"""Traffic of a seeded grasp: the same messages and packets at the same times, however computed."""

import hashlib
from typing import Any

import pytest

from cell.build import build_cell
from cell.control.plan import GraspStep, Pose
from tests.cell.conftest import small_config

_CAN = "6734 messages, sha256 3ce7e6decd70998c"
_SERVOS = "1290 packets, sha256 02dbbd6bafca822c"
"""Traffic of the grasp below. A change of what the control wants or of the simulated physics makes
another one; a change of how fast the simulation is computed must not."""
_DECIMALS = 9
"""Of the times in s that count: sums in another order differ behind them."""


class Digest:
    """Sum over all that goes over one line, with its times."""

    def __init__(self) -> None:
        self._sha = hashlib.sha256()
        self._n = 0

    def add(self, t_s: float, *content: Any) -> None:
        self._sha.update(repr((round(t_s, _DECIMALS), *content)).encode())
        self._n += 1

    def text(self, unit: str) -> str:
        return f"{self._n} {unit}, sha256 {self._sha.hexdigest()[:16]}"


# Another kind of processor may round sums in another way: no test of each change.
@pytest.mark.long
def test_a_seeded_grasp_makes_the_same_traffic() -> None:
    cell = build_cell(small_config(tactile__force_period_ms=2, seed=7))
    can, servos = Digest(), Digest()
    simulated = cell.simulated
    line = simulated.devices.servo_bus
    receive, transmit = line.receive, line.transmit

    def received(data: bytes, now_s: float, **more: Any) -> None:
        servos.add(now_s, "host", bytes(data))
        receive(data, now_s, **more)

    def transmitted(now_s: float) -> bytes:
        data = transmit(now_s)
        if data:
            servos.add(now_s, "servos", data)
        return data

    line.receive, line.transmit = received, transmitted  # type: ignore[method-assign]
    simulated.can_bus.capture.append(can.add)
    cell.controller.start()
    cell.controller.moves.present("box")
    cell.controller.grasp(GraspStep(pose=Pose(rotation_rad=0.3), force_n=5.0))
    simulated.can_bus.flush()
    cell.close()
    assert can.text("messages") == _CAN
    assert servos.text("packets") == _SERVOS
