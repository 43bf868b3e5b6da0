"""The link on a real SocketCAN interface; in a virtual machine by `make vcan`, elsewhere skipped.

The control unit is a process of its own on the same interface.
"""

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from tactile.can.bus import close_bus, open_bus
from tactile.control_unit.node import TactileLink
from tactile.control_unit.settings import LinkSettings
from tactile.errors import FrameTimeout, HeartbeatLost
from tactile.layout import paper_layout

CHANNEL = os.environ.get("TACTILE_CELL_VCAN", "")
pytestmark = pytest.mark.skipif(not CHANNEL, reason="needs SocketCAN: make vcan")
LAYOUT = paper_layout()
NODE = 5
# The emulated processor is slow: few frames a second, long patience.
SETTINGS = LinkSettings(sync_period_s=0.25, heartbeat_s=0.5, startup_timeout_s=60, sdo_timeout_s=5)


@pytest.fixture
def unit() -> Iterator["subprocess.Popen[str]"]:
    script = Path(__file__).with_name("unit_on_socketcan.py")
    with subprocess.Popen(
        [sys.executable, str(script), CHANNEL, str(NODE)], stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout.readline() == "ready\n"
        yield process
        process.kill()


@pytest.fixture
def link() -> Iterator[TactileLink]:
    bus = open_bus("socketcan", CHANNEL)
    made = TactileLink(bus, node_id=NODE, layout=LAYOUT, settings=SETTINGS)
    yield made
    made.close()
    close_bus(bus)


def frames(link: TactileLink, n: int) -> list[np.ndarray]:
    received: list[np.ndarray] = []
    deadline_s = time.monotonic() + 60.0
    while len(received) < n:
        received += [frame.counts for frame in link.poll().frames]
        assert time.monotonic() < deadline_s, f"{len(received)} of {n} frames came"
        time.sleep(0.005)
    return received


def test_whole_frames_come(link, unit) -> None:
    identity = link.start()
    assert (identity.serial, identity.product_code) == (77, 0x408)
    counts, statistics = frames(link, 12), link.statistics
    assert statistics.frames.lost == statistics.frames.torn == statistics.frames.corrupt == 0
    assert all(one.shape == (408,) for one in counts)
    assert any((a != b).any() for a, b in pairwise(counts))


def test_a_unit_that_dies_is_noticed(link, unit) -> None:
    link.start()
    frames(link, 2)
    unit.kill()
    died_s = time.monotonic()
    with pytest.raises((HeartbeatLost, FrameTimeout)) as caught:
        frames(link, 100)
    assert time.monotonic() - died_s < 5.0
    with pytest.raises(type(caught.value)):
        link.poll()
