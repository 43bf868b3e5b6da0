"""Rows 35 and 40: a host that falls silent, a wall clock that jumps."""

import re
import threading
import time
from unittest import mock

import numpy as np

from benchmarks.fault_campaign.host_jobs import once_in
from benchmarks.fault_campaign.row import FaultRow, Observed
from benchmarks.fault_campaign.scenario import (
    campaign_cell,
    campaign_config,
)
from cell.collect import GraspRecord
from cell.plugin import TactileCellPlugin, TeachGoal
from cell.states import CellState
from gripper.state import GripperPhase

HOUR_S = 3600.0
HOST_TIMEOUT_S = 0.3


# -- 35: the host is silent ------------------------------------------------------------------


def _silent_host() -> Observed:
    config = campaign_config(host_timeout_s=HOST_TIMEOUT_S)
    with TactileCellPlugin(config) as plugin:
        job = plugin.start(TeachGoal(label="ball", grasps=1000))
        threading.Event().wait(3.0 * HOST_TIMEOUT_S)
        status, state = plugin.feedback(job), plugin.state()
        if state == CellState.HELD:
            plugin.release()
        silent = re.search(r"host was silent for ([0-9.]+) s", status.error)
        return Observed(
            reaction="HOLD" if silent is not None else status.outcome.value,
            detected_after_s=None if silent is None else float(silent[1]),
            outcome=f"{state}, job {status.outcome.value}, readable later: {status.error[:90]}",
        )


# -- 40: the wall clock ----------------------------------------------------------------------


def _grasp_with_clock(step_s: float) -> tuple[GraspRecord, float]:
    """Grasp while the wall clock jumps in the ramp; return the record and how long it took."""
    offset_s = [0.0]
    now, now_ns = time.time, time.time_ns

    def jumping() -> float:
        return now() + offset_s[0]

    def jumping_ns() -> int:
        return now_ns() + int(offset_s[0] * 1e9)

    with (
        mock.patch("time.time", jumping),
        mock.patch("time.time_ns", jumping_ns),
        campaign_cell() as cell,
    ):
        jumped = once_in(cell, GripperPhase.RAMPING, lambda: offset_s.__setitem__(0, step_s))
        cell.start()
        record: GraspRecord = cell.grasp()
        assert jumped
        return record, cell.now_s


def _wall_clock(step_s: float) -> Observed:
    plain, plain_s = _grasp_with_clock(0.0)
    jumped, jumped_s = _grasp_with_clock(step_s)
    same = (
        np.array_equal(plain.grasp.counts, jumped.grasp.counts)
        and plain.cycles == jumped.cycles
        and plain_s == jumped_s
    )
    return Observed(
        reaction="NOTHING" if same else "DIFFERENT",
        detected_after_s=None,
        outcome="each frame and each period of the loop is the same as without the jump; the "
        "recording has both clocks at its start and at each change of state",
    )


ROWS: tuple[FaultRow, ...] = (
    FaultRow(
        row=35,
        variant="silent host",
        fault="the host that has loaded the plugin makes no call any more, mid-job",
        injected=f"no call for {HOST_TIMEOUT_S:g} s (host_timeout_s)",
        reaction="HOLD",
        limit_s=2.0 * HOST_TIMEOUT_S,
        run=_silent_host,
        real_time=True,
    ),
    *(
        FaultRow(
            row=40,
            variant=variant,
            fault="the wall clock jumps in the ramp",
            injected=f"{step_s:+g} s",
            reaction="NOTHING",
            limit_s=None,
            run=lambda step_s=step_s: _wall_clock(step_s),
        )
        for variant, step_s in (
            ("an hour on", HOUR_S),
            ("an hour back", -HOUR_S),
            ("NTP step", -0.4),
        )
    ),
)
