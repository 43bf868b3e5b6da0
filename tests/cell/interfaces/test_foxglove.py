"""The live stream for Foxglove, with `websockets` as its client."""

import json
import struct
import threading
from collections.abc import Iterator
from contextlib import closing
from typing import Any

import pytest
from websockets.sync.client import ClientConnection, connect

from cell.control.journal import Journal
from cell.control.plan import Pose
from cell.data.recorder import Recorder
from cell.data.recording_schema import CYCLE, EVENT, FRAME, SCHEMAS, STATE
from cell.errors import CellError
from cell.interfaces.foxglove import FoxgloveDoor
from tests.cell.conftest import plain_pads
from tests.cell.interfaces.conftest import until
from tests.fuzz.harness import Clock

SUBPROTOCOL = "foxglove.sdk.v1"
WALL_S = 1_700_000_000
"""Unix time of the tests in s."""


class Viewer:
    """A client as Foxglove is one, of the published protocol."""

    def __init__(self, link: ClientConnection) -> None:
        self._link = link
        self.channels: dict[str, dict[str, Any]] = {}
        self._topics: dict[int, str] = {}
        while len(self.channels) < len(SCHEMAS):
            message = json.loads(link.recv(20.0))
            if message["op"] == "advertise":
                self.channels |= {one["topic"]: one for one in message["channels"]}

    def subscribe(self, *topics: str) -> None:
        first = len(self._topics)
        self._topics |= dict(enumerate(topics, first))
        wanted = [
            {"id": first + n, "channelId": self.channels[topic]["id"]}
            for n, topic in enumerate(topics)
        ]
        self._link.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))

    def receive(self) -> tuple[str, int, Any]:
        """Return topic, time in ns and content of the next message."""
        while True:
            data = self._link.recv(20.0)
            if isinstance(data, bytes) and data[0] == 1:
                number, stamp_ns = struct.unpack_from("<IQ", data, 1)
                return self._topics[number], stamp_ns, json.loads(data[13:])


@pytest.fixture
def door() -> Iterator[FoxgloveDoor]:
    with closing(FoxgloveDoor(0, lambda: WALL_S * 10**9)) as made:
        yield made


@pytest.fixture
def viewer(door: FoxgloveDoor) -> Iterator[Viewer]:
    with connect(f"ws://127.0.0.1:{door.port}", subprotocols=[SUBPROTOCOL]) as link:  # type: ignore[list-item]
        yield Viewer(link)


def test_the_channels_of_a_recording_are_advertised_with_their_schemas(viewer: Viewer) -> None:
    assert set(viewer.channels) == set(SCHEMAS)
    for topic, channel in viewer.channels.items():
        assert channel["encoding"] == "json"
        assert channel["schemaEncoding"] == "jsonschema"
        assert channel["schemaName"] == SCHEMAS[topic]["title"]
        assert json.loads(channel["schema"]) == SCHEMAS[topic]


def test_messages_come_as_they_are_recorded_stamped_with_the_wall_clock(
    viewer: Viewer, door: FoxgloveDoor
) -> None:
    clock = Clock(now_s=50.0)
    recorder = Recorder(None, clock, pads=plain_pads((4, 3), (4, 3)), tap=door)
    assert recorder.path is None
    Journal(recorder).note("note", "nobody looks")
    viewer.subscribe(EVENT)
    until(lambda: door.wants(EVENT))
    assert not door.wants(CYCLE)
    Journal(recorder).note("note", "first")
    clock.now_s += 0.25
    Journal(recorder).note("note", "second")
    assert viewer.receive() == (
        EVENT,
        WALL_S * 10**9,
        {"t_s": 50.0, "kind": "note", "text": "first"},
    )
    topic, stamp_ns, content = viewer.receive()
    assert (topic, content["text"]) == (EVENT, "second")
    assert stamp_ns - WALL_S * 10**9 == pytest.approx(0.25e9)
    clock.now_s += 3600.0  # the cell's time has run ahead: it is related to real time anew
    Journal(recorder).note("note", "third")
    assert viewer.receive()[1] == WALL_S * 10**9
    recorder.close()


def test_a_grasp_of_a_cell_without_recording_is_streamed(
    viewer: Viewer, door: FoxgloveDoor, make_bench: Any
) -> None:
    bench = make_bench(tap=door).ready()
    assert bench.cell.recording_path is None
    viewer.subscribe(CYCLE, FRAME, STATE)
    until(lambda: door.wants(CYCLE) and door.wants(FRAME) and door.wants(STATE))
    bench.controller.grip(3.0, Pose())
    bench.cell.close()
    states, seen = [], set()
    while not states or states[-1] != "STOPPED":
        topic, _stamp_ns, content = viewer.receive()
        seen.add(topic)
        if topic == STATE:
            states.append(content["state"])
    assert seen == {CYCLE, FRAME, STATE}
    assert "COMPLETE" in states


def test_the_thread_that_makes_messages_sends_none(door: FoxgloveDoor) -> None:
    sent_by: list[str] = []

    class Channel:
        def log(self, _data: bytes, *, log_time: int) -> None:
            sent_by.append(threading.current_thread().name)

    door._channels = {EVENT: Channel()}  # type: ignore[dict-item]
    for number in range(10_000):
        door.take(EVENT, number, b"{}")
    door.close()
    assert set(sent_by) == {"foxglove"}


def test_a_taken_port_names_the_option(door: FoxgloveDoor) -> None:
    with pytest.raises(CellError, match=rf":{door.port} .*--foxglove PORT takes another one"):
        FoxgloveDoor(door.port)
