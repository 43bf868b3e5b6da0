"""Simulated servos against logs of real ones: a log outside its target is found."""

import json
import os
import re
from pathlib import Path

import numpy as np
import pytest

from benchmarks.performance import servo_logs
from benchmarks.performance.servo_logs import Bench, Log, main, read_logs
from gripper.dynamixel.models import XL330_M288, XM430_W350

TIME_S = np.arange(0.0, 1.5, 0.01)
SWING_RAD = 0.5 * np.sin(4.0 * TIME_S)


def arm(late: bool) -> dict[str, np.ndarray]:
    """Return the log of one joint, its velocity as the register has it or without a delay."""
    speed = 2.0 * np.cos(4.0 * TIME_S)
    if late:
        speed, _ = Bench(Log("", XM430_W350, TIME_S, SWING_RAD, speed)).run()
    return {"t": TIME_S, "q3": SWING_RAD, "dq3": speed}


def pendulum(divisor: float) -> dict[str, np.ndarray]:
    """Return the log of a servo that holds still, with the P gain over a divisor."""
    zeros, goal = np.zeros_like(TIME_S), 0.1 + 0.2 * TIME_S
    log = Log("", XL330_M288, TIME_S, zeros, zeros)
    pwm = np.trunc(400 * np.rint(goal / log.model.rad_per_pulse) / divisor) % 0x10000
    meta = {"motor": "xl330", "kp": 400, "mass": 0.5, "length": 0.1, "trajectory": "other"}
    return {
        "meta": np.array(json.dumps(meta)),
        **{"timestamp": TIME_S, "position": zeros, "speed": zeros, "goal_position": goal},
        **{"load": pwm, "input_volts": zeros + 7.3, "torque_enable": zeros + 1.0},
    }


@pytest.mark.parametrize(
    ("log", "outside"),
    [
        (arm(late=True), ""),
        (arm(late=False), "3 .* velocity 0.2.* OUTSIDE"),
        (pendulum(256.0), ""),
        (pendulum(128.0), "PWM .* OUTSIDE"),
        ({"t": TIME_S, "q1": SWING_RAD}, "ERROR .*a.npz is no log of a servo: it lacks 'dq1'"),
        (pendulum(256.0) | {"load": TIME_S[:9]}, "ERROR .*a.npz .* length"),
        (arm(late=True) | {"t": TIME_S[::-1]}, "ERROR .*a.npz .* times"),
        (arm(late=True) | {"q3": TIME_S * np.nan}, "ERROR .*a.npz .* no number"),
    ],
)
def test_each_log_has_a_line_and_one_outside_ends_it_with_1(log, outside, tmp_path, capsys) -> None:
    np.savez(tmp_path / "a.npz", **log)
    if outside:
        with pytest.raises(SystemExit) as ended:
            main(folder=str(tmp_path))
        assert ended.value.code == 1
    else:
        main(folder=str(tmp_path))
    lines = capsys.readouterr().out.splitlines()
    (line,) = (one for one in lines if one.startswith("a"))
    assert line.count("OUTSIDE") + line.count("ERROR") == bool(outside)
    if outside:
        assert re.search(outside, line)


def test_a_file_that_is_no_archive_is_named_and_so_is_an_empty_folder(tmp_path, capsys) -> None:
    with pytest.raises(SystemExit, match="has no log"):
        main(folder=str(tmp_path))
    for name, data in (("b.npz", b"nothing"), ("c.npz", b"PK\x03\x04 cut off")):
        (tmp_path / name).write_bytes(data)
    with pytest.raises(SystemExit):
        main(folder=str(tmp_path))
    assert capsys.readouterr().out.count("ERROR") == 2


@pytest.mark.slow
@pytest.mark.shared_data
def test_the_simulated_servos_follow_the_logs_of_real_ones(capsys) -> None:
    folder = os.environ.get("TACTILE_CELL_DATA")
    if folder is None:
        pytest.skip("TACTILE_CELL_DATA does not name the folder with servos/")
    servos = Path(folder) / "servos"
    main(folder=str(servos))
    printed = capsys.readouterr().out
    assert all(log.name in printed for path in servos.glob("*.npz") for log in read_logs(path))
    assert servo_logs.SPEED_RMS_RAD_S == {"430 size": 0.018, "330 size": 0.04}
