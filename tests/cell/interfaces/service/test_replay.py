"""A recording in the place of a cell: what it shows when, its controls, and that nothing moves."""

import shutil
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cell.config.model import CellConfig
from cell.control.plan import Pose
from cell.data.recorder import Recorder
from cell.data.recording_reader import read_recording
from cell.errors import RecordingError, RequestRefused
from cell.interfaces.service.replay import Replay, Tape
from cell.interfaces.service.service import Service
from cell.interfaces.service.serving import open_doors
from cell.interfaces.service.state import state_values
from tests.cell.conftest import plain_pads
from tests.cell.interfaces.hosts import Client
from tests.fuzz.harness import Clock


@pytest.fixture(scope="module")
def recording(taught: Any) -> Any:
    """Five grasps of ball, five of box, then one identification of each."""
    return read_recording(taught.result.recording)


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def replay(taught: Any, clock: Clock) -> Replay:
    return Replay(taught.result.recording, clock=clock)


@pytest.fixture
def host(replay: Replay) -> Iterator[tuple[Service, Client]]:
    """A replay behind HTTP, and a client with its token."""
    doors = {"modbus_port": None, "xmlrpc_port": None, "http_port": 0}
    service = Service(replay, CellConfig(serve=doors))
    with closing(service), open_doors(service) as found:
        yield service, Client(found)


def go_to(replay: Replay, clock: Clock, t_s: float) -> None:
    """Play until a time of the recording."""
    now_s = replay.moment()[1]
    assert t_s >= now_s
    clock.now_s += t_s - now_s


def test_it_shows_what_was_measured_at_each_time(
    replay: Replay, clock: Clock, recording: Any
) -> None:
    assert replay.values() | {"t_s": 0.0} == {
        "paused": False,
        "speed": 1.0,
        "grasp": 0,
        "of": len(recording.grasps),
        "t_s": 0.0,
        "time_s": pytest.approx(1e-9 * recording.wall_clock_start_ns + recording.cycles.t_s[0]),
        "duration_s": recording.states[-1]["t_s"] - recording.cycles.t_s[0],
        "name": "recording.mcap",
        "lost_reason": "",
    }
    assert replay.status().state == "STARTING"
    cycles = recording.cycles
    pressed = int(np.flatnonzero(np.array(cycles.phase) == "RAMPING")[40])
    go_to(replay, clock, float(cycles.t_s[pressed]) + 1e-6)
    status = replay.status()
    assert (status.state, status.grasp, status.holding) == ("EXECUTE", "GRIPPING", True)
    assert status.live.force_n == pytest.approx(cycles.force_n[pressed].mean())
    assert status.live.setpoint_n == pytest.approx(cycles.setpoint_n[pressed])
    assert status.live.opening_mm == pytest.approx(1e3 * cycles.aperture_m[pressed])
    assert status.live.temperature_c is not None
    counts = status.live.counts
    assert counts is not None
    force_n = replay.newtons(counts)
    assert force_n is not None
    assert force_n.sum() / 2 == pytest.approx(status.live.force_n, rel=0.3)


def test_pause_speed_and_grasp_move_it(replay: Replay, clock: Clock, recording: Any) -> None:
    replay.control(grasp=7, pause=True)
    clock.now_s += 60.0
    assert replay.values()["grasp"] == 7
    assert replay.moment()[1] == recording.grasp_t_s[6]
    replay.control(pause=False, speed=4.0)
    clock.now_s += 0.5
    assert replay.moment()[1] == pytest.approx(recording.grasp_t_s[6] + 2.0)
    replay.control(speed=0.5)
    clock.now_s += 1.0
    assert replay.moment()[1] == pytest.approx(recording.grasp_t_s[6] + 2.5)
    clock.now_s += 3600.0
    assert replay.values()["paused"]
    assert replay.moment()[1] == replay.moment()[0].end_s
    replay.control(pause=False)
    assert replay.values()["t_s"] == 0.0


@pytest.mark.parametrize("wrong", [{"speed": 0.0}, {"speed": 101.0}, {"grasp": 0}, {"grasp": 99}])
def test_a_wrong_control_changes_nothing(replay: Replay, wrong: dict[str, Any]) -> None:
    before = replay.values()
    with pytest.raises(RequestRefused, match=rf"{next(iter(wrong))} is .*: (give|the recording)"):
        replay.control(**wrong)
    assert replay.values() == before


def test_answers_stand_in_the_ledger_until_a_step_back(
    replay: Replay, clock: Clock, recording: Any
) -> None:
    service = Service(replay, CellConfig())
    with closing(service):
        assert state_values(service)["shift"]["answers"] == []
        go_to(replay, clock, replay.moment()[0].end_s)
        state = state_values(service)
        assert [one["label"] for one in state["shift"]["answers"]] == [
            row["label"] for row in recording.results
        ]
        assert state["last_answer"]["label"] == recording.results[-1]["label"]
        assert state["shift"]["answers"][0]["time_s"] == pytest.approx(
            1e-9 * recording.wall_clock_start_ns + recording.results[0]["t_s"]
        )
        curves = service.shift.grasp(2)
        assert curves is not None
        assert len(curves["t_s"]) == len(curves["force_n"]) > 50
        assert sum(curves["frame"]) / 2 == pytest.approx(max(curves["force_n"]), rel=0.3)
        assert service.shift.grasp(3) is None
        replay.control(grasp=1)
        assert state_values(service)["shift"]["answers"] == []
        assert state_values(service)["last_answer"] is None


def test_a_fault_is_shown_with_its_number(tmp_path: Path, make_bench: Any) -> None:
    bench = make_bench(folder=tmp_path).ready()
    bench.inject("can.off@contact+0.3s")
    with pytest.raises(Exception, match="bus"):
        bench.controller.grip(3.0, Pose())
    bench.cell.close()
    clock = Clock()
    replay = Replay(tmp_path / "recording.mcap", clock=clock)
    clock.now_s += 3600.0
    status = replay.status()
    assert (status.state, status.fault_number, status.n_faults) == ("ABORTED", 311, 1)
    assert status.fault is not None
    assert status.fault_since_s is not None


def test_commands_are_refused_with_the_reason(host: Any) -> None:
    _service, client = host
    state = client.get("/api/state")
    assert client.get("/api/info")["mode"] == "replay"
    assert all("replay of a recording" in one["text"] for one in state["allowed"].values())
    lease = client.post("/api/lease", name="host")["lease"]
    goal = {"task": "teach", "label": "ball"}
    for path, body in (("jobs", {"goal": goal}), ("commands", {"command": "reset"})):
        status, answer = client.ask("POST", f"/api/{path}", {"lease": lease, **body})
        assert (status, answer["fault_number"]) == (422, 513)
        assert "nothing moves" in answer["error"]
    assert client.ask("POST", "/api/hold")[0] == 200


def test_the_page_controls_it_and_all_clients_see_it(host: Any) -> None:
    _service, client = host
    assert client.post("/api/replay", pause=True, grasp=3)["grasp"] == 3
    replay = client.get("/api/state")["replay"]
    assert (replay["paused"], replay["grasp"]) == (True, 3)
    assert client.ask("POST", "/api/replay", {"grasp": 99})[0] == 422
    assert client.ask("POST", "/api/replay", {"pause": True}, token=None)[0] == 401


def send(client: Client, body: bytes, **options: Any) -> tuple[int, Any]:
    return client.send("PUT", "/api/replay", body, **options)[:2]


def test_a_recording_that_is_sent_is_played(
    host: Any, taught: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    _service, client = host
    data = Path(taught.result.recording).read_bytes()
    assert len(data) > 65536
    client.post("/api/replay", grasp=5, pause=True)
    status, answer = send(client, data)
    assert (status, answer["name"], answer["grasp"]) == (200, "the recording sent", 0)
    assert not answer["paused"]
    assert send(client, data, token="wrong")[0] == 401


def test_what_is_no_recording_is_refused_and_the_one_before_goes_on(
    host: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    _service, client = host
    status, answer = send(client, b"no recording")
    assert status == 422
    assert "the file is no recording" in answer["error"]
    assert client.get("/api/state")["replay"]["name"] == "recording.mcap"
    monkeypatch.setattr("cell.interfaces.web.UPLOAD_BYTES", 100_000)
    status, answer = send(client, bytes(100_001))
    assert (status, answer["fault_number"]) == (413, 513)
    assert client.ask("POST", "/api/replay", {"pause": True, "x": "y" * 70_000})[0] == 413


def test_a_cell_takes_no_recording(serve: Any) -> None:
    client = Client(serve("http").doors)
    assert send(client, b"no recording")[0] in (404, 405)
    assert send(client, bytes(70_000))[0] == 413
    assert client.get("/api/state")["replay"] is None


def test_a_recording_of_other_pads_or_with_nothing_in_it(
    tmp_path: Path, taught: Any, clock: Clock
) -> None:
    Recorder(tmp_path / "empty.mcap", clock, pads=plain_pads((4, 3), (4, 3))).close()
    with pytest.raises(RecordingError, match="nothing to show"):
        Replay(tmp_path / "empty.mcap")
    recording = read_recording(taught.result.recording)
    cut = tmp_path / "cut.mcap"
    shutil.copyfile(taught.result.recording, cut)
    with cut.open("r+b") as file:
        file.truncate(cut.stat().st_size // 2)
    assert Replay(cut).values()["lost_reason"]
    recording.metadata["config"] = '{"of another version": 1}'
    strange = Tape(recording)
    assert strange.config.name == recording.metadata["cell"]
    assert strange.info()["n_taxels"] == recording.pads.n_taxels


@pytest.mark.parametrize(
    "spoil",
    [
        {"states": ({"t_s": 1.0, "state": "DANCING", "grasp": "IDLE"},)},
        {"states": ({"t_s": 1.0, "state": "IDLE", "grasp": None},)},
        {"events": ({"t_s": "soon", "kind": "fault", "text": "", "fault_number": 311},)},
        {"results": ({"t_s": 1.0, "label": "ball", "labels": ["ball"], "probabilities": []},)},
        {"results": ({"t_s": 1.0, "label": "ball", "labels": 3, "unknown": 0.0},)},
    ],
)
def test_values_that_no_cell_has_are_refused_before_they_are_shown(
    recording: Any, spoil: dict[str, Any]
) -> None:
    Tape(recording)
    with pytest.raises(RecordingError, match="values that no cell has"):
        Tape(replace(recording, **spoil))


def test_a_fault_that_the_catalogue_lacks_is_no_fault(recording: Any) -> None:
    strange = {"t_s": 1.0, "kind": "fault", "text": "of the future", "fault_number": 99_999}
    aborted = {"t_s": 1.0, "state": "ABORTED", "grasp": "ERROR"}
    status = Tape(replace(recording, events=(strange,), states=(aborted,))).status_at(2.0)
    assert (status.state, status.fault, status.fault_number) == ("ABORTED", None, 0)
