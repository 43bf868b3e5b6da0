"""The cell over HTTP and WebSocket, with the standard library and `websockets` as clients."""

import asyncio
import json
import math
import re
import socket
import ssl
import threading
import time
from collections import deque
from contextlib import ExitStack, closing
from http.client import HTTPSConnection
from importlib.metadata import version
from typing import Any
from urllib.parse import quote
from xmlrpc.client import dumps as xmlrpc_dumps

import numpy as np
import pytest
from websockets.asyncio.client import connect as open_in_one_thread
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect as open_socket

from cell.interfaces.http_server import HttpServer
from cell.interfaces.opening import running
from cell.interfaces.web import WebInterface
from cell.runtime.goals import TASKS, checked_goal
from tactile.errors import HeartbeatLost
from tests import ROOT, blocks
from tests.cell.cells import COARSE_PADS, REAL
from tests.cell.interfaces.hosts import Client
from tests.cell.served import BRISK, ended, serving
from tests.values import raising
from tests.waiting import until

PAGE = ROOT / "docs/how-to/use-it-over-http.md"


def test_the_state_names_who_commands_and_keeps_the_last_answer(served, host) -> None:
    first = served.service.lease.acquire("PLC")
    lease = host.post("/api/lease", name="host", take=True)["lease"]
    assert not served.service.lease.has(first)
    assert host.post(f"/api/lease/{lease}/alive") == {"lease": lease}
    host.post("/api/jobs", lease=lease, goal={"task": "identify", "present": "box"})
    job, now = host.get("/api/jobs/1"), host.get("/api/state")
    part = job["part"]
    assert (part["shape"], now["commander"], now["job"]) == ("sphere", "host", job)
    assert now["last_answer"] == now["shift"]["answers"][-1] == part
    assert now["live"].keys() == {
        *("force_n", "force_age_s", "setpoint_n", "opening_mm", "temperature_c", "frame_age_s")
    }
    assert host.ask("DELETE", f"/api/lease/{lease}") == (200, {"lease": 0})
    assert not served.service.lease.has(lease)


def test_refusals_have_a_status_and_a_fault_number(served, host) -> None:
    lease = host.post("/api/lease", name="host")["lease"]
    identify = {"task": "identify"}
    for path, body, status, number in (
        ("/api/lease", {"name": "other"}, 403, 514),
        ("/api/jobs", {"lease": lease + 1, "goal": identify}, 403, 514),
        ("/api/jobs", {"lease": lease, "goal": {"task": "dance"}}, 422, 501),
        ("/api/jobs", {"lease": lease, "goal": identify, "job": 5}, 422, 513),
        ("/api/commands", {"lease": lease, "command": "reset"}, 409, 505),
        ("/api/commands", {"lease": lease, "command": "release"}, 422, 513),
        ("/api/pose", {"lease": lease, "seq": 1, "ok": True}, 422, 513),
        ("/api/pose", {"lease": lease, "seq": 1, "ok": True, "pose": {"w": 1}}, 422, 513),
    ):
        answer = host.ask("POST", path, body)
        check_refusal(*answer, status=status)
        assert answer[1]["fault_number"] == number, path
    for path, body in (
        ("/api/jobs", {"lease": "x", "goal": identify}),
        ("/api/jobs", {"lease": math.nan, "goal": identify}),
        ("/api/jobs", {"lease": lease}),
        ("/api/commands", {"lease": lease, "command": "grasp"}),
        ("/api/commands", {"lease": lease, "command": "reset", "force": 1}),
        # A text that no answer can have.
        ("/api/lease", {"name": "\ud800"}),
        ("/api/simulation/faults", {"fault": "\udfff"}),
        ("/api/simulation/part", {"lease": lease, "part": "\ud800"}),
        ("/api/jobs", {"lease": lease, "goal": {"task": "teach", "label": "\ud800"}}),
        ("/api/jobs", {"lease": lease, "goal": {"task": "\ud800"}}),
    ):
        check_refusal(*host.ask("POST", path, body), status=422)
    served.service.stop = (stops := []).append
    for way, path, status, remedy in (
        ("GET", "/api/jobs/3", 404, "numbers in GET /api/jobs"),
        ("GET", "/api/grasps/3", 404, "`shift.answers`"),
        ("GET", "/api/nothing", 404, "paths in /openapi.json"),
        ("DELETE", "/api/jobs/3", 405, "methods of each path"),
        ("POST", f"/api/hold?latch=perhaps&name={61 * 'x'}", 422, "Correct the request."),
    ):
        check_refusal(*(answer := host.ask(way, path)), status=status)
        assert remedy in answer[1]["remedy"], path
    assert stops == [f"by HTTP 127.0.0.1 {60 * 'x'}"]
    for more, status, remedy in (
        ({"token": "wrong"}, 401, "Send the token"),
        ({"token": None}, 401, "Send the token"),
        ({"body": {"x": "y" * 70_000}}, 413, "smaller"),
        ({"Transfer-Encoding": "chunked"}, 413, "Content-Length"),
        ({"Origin": "http://evil.example"}, 403, "from a page of this cell"),
        ({"Host": "evil.example"}, 403, "`serve.hosts`"),
    ):
        check_refusal(*(answer := host.ask("POST", "/api/lease", **more)), status=status)
        assert remedy in answer[1]["remedy"], more
    assert (served.plugin.job().number, host.get("/api/state")["commander"]) == (0, "host")


def check_refusal(answered: int, answer: Any, *, status: int) -> None:
    """Check status and the one shape of all refusals, which has no name of a function in it."""
    assert answered == status, answer
    assert answer.keys() == {"fault_number", "error", "remedy"}
    assert answer["fault_number"] >= 100
    assert answer["error"]
    assert answer["remedy"]
    assert "__" not in answer["error"]


def test_the_state_says_what_is_allowed_and_since_when(served, host) -> None:
    begin_s, now = time.time(), host.get("/api/state")
    assert begin_s - 1.0 <= now["time_s"] <= time.time() + 1.0
    may = {task for task, refused in now["allowed"].items() if refused is None}
    assert may == {"teach", "gauge", "zero", "identify", "grip", "sort", "release", "shutdown"}
    refused = now["allowed"]["reset"]
    assert (refused["number"], bool(refused["remedy"])) == (505, True)
    lease = host.post("/api/lease", name="host")["lease"]
    served.plugin.pause()
    host.post("/api/jobs", lease=lease, goal={"task": "identify"})
    now = host.get("/api/state")
    assert set(now["allowed"]) == set(may) | {"verify", "clear", "reset"}
    assert all("job 1 is not over" in one["text"] for one in now["allowed"].values())
    assert begin_s <= now["job"]["since_s"] <= now["time_s"]
    served.plugin.go_on()
    host.ask("POST", "/api/hold?latch=true&name=gate", token=None)
    allowed = host.get("/api/state")["allowed"]
    assert {task for task, one in allowed.items() if one is None} == {"shutdown"}
    assert allowed["teach"]["number"] == 515


def test_a_fault_has_its_remedy_and_steps(served, host) -> None:
    assert host.get("/api/state")["fault"] is None
    lease = host.post("/api/lease", name="host")["lease"]
    served.plugin.pause()
    host.post("/api/jobs", lease=lease, goal={"task": "grip", "force_n": 3.0})
    served.plugin.fail(HeartbeatLost("no heartbeat for 0.3 s"))
    now = host.get("/api/state")
    fault, status = now["fault"], now["status"]
    assert (fault["number"], fault["recording"]) == (305, None)
    for name, value in (("number", "fault_number"), ("detail", "fault")):
        assert fault[name] == status[value]
    assert fault["since_s"] == status["fault_since_s"] > 0.0
    assert fault["steps"] == ["look", "mend", "clear", "support_part", "release", "reset"]
    listed = {one["number"]: one for one in host.get("/api/faults")}
    assert {name: fault[name] for name in listed[100]} == listed[fault["number"]]
    assert sorted(listed) == list(listed)


@pytest.mark.slow
def test_a_simulated_cell_shows_pads_shift_grasps_and_health(connect) -> None:
    served, host = connect(cell={}, sequence__decide_early=False)
    info = host.get("/api/info")
    assert (info["mode"], info["simulated"]) == ("cell", True)
    assert info["version"] == version("tactile-cell")
    pads = info["pads"]
    assert [pad["name"] for pad in pads if pad["inner"]] == ["finger0.inner", "finger1.inner"]
    assert pads[0]["pitch_mm"] == pytest.approx([3.44, 5.0], abs=0.01)
    assert info["force_cap_n"] == served.service.config.gripper.force_max_n
    assert info["opening_max_mm"] == served.service.config.gripper.aperture_open_mm
    lease = host.post("/api/lease", name="host")["lease"]
    host.post("/api/jobs", lease=lease, goal={"task": "sort", "parts": 1, "max_grasps": 1})
    assert served.ended().error == ""
    now = host.get("/api/state")
    assert now["shift"]["parts"] == 1
    (ball,) = now["shift"]["answers"]
    assert (ball["label"], ball["task"], ball["place"]) == ("ball", "sort", "ball")
    grasp = host.get(f"/api/grasps/{ball['number']}")
    n_points = len(grasp["t_s"])
    assert 100 < n_points <= 300
    assert {len(grasp[name]) for name in ("force_n", "setpoint_n", "opening_mm")} == {n_points}
    assert len(grasp["frame"]) == 408
    inner_n = sum(grasp["frame"][:64])
    assert inner_n == pytest.approx(max(one or 0.0 for one in grasp["force_n"]), rel=0.3)
    assert now["health"].keys() >= {"servos", "can", "loop", "recording"}


def test_taught_objects_are_listed_shown_and_forgotten_by_any_label(served, host) -> None:
    lease = host.post("/api/lease", name="host")["lease"]
    assert [one["label"] for one in host.get("/api/taught")] == ["ball", "box"]
    first = host.get("/api/info")["objects"][0]
    assert (first["label_id"], first["n_grasps"]) == (1, 5)
    for label in ("ball/last", "a?b#c%2F"):
        served.plugin.model.taught[label] = {"n_grasps": 5, "shape": "sphere", "size_mm": 9.5}
        at = f"/api/taught/{quote(label, safe='')}"
        assert host.ask("DELETE", f"{at}?lease={lease}&last=true")[0] == 200
        assert served.plugin.asked[-1] == ("forget", True)
        assert (served.plugin.model.taught[label]["n_grasps"], label) == (4, label)
        check_refusal(*host.ask("DELETE", at), status=422)
        assert host.ask("DELETE", f"{at}?lease={lease}")[0] == 200
        assert [one["label"] for one in host.get("/api/taught")] == ["ball", "box"]
    assert served.plugin.model.taught["ball"]["n_grasps"] == 5
    assert host.post("/api/commands", lease=lease, command="forget_drift") == {"job": 5}


@pytest.mark.slow
def test_faults_of_a_simulated_cell_begin_and_end_on_request(connect, capsys) -> None:
    _, host = connect(cell={})
    kinds = {one["name"]: one for one in host.get("/api/simulation/faults")["kinds"]}
    assert {"servo1.off", "servo2.off", "taxels.saturated", "object.gone"} <= set(kinds)
    assert not any(name.startswith("axis") for name in kinds)
    assert kinds["can.loss"]["value"] == {
        "unit": "share", "low": 0.0, "high": 1.0, "default": 0.05, "whole": False,
    }  # fmt: skip
    first, faults, _ = page_examples(host)
    typed: dict[str, Any] = {}
    exec(first.partition("\nlease =")[0], typed)
    begin, show, end = faults.splitlines()
    exec(f"{begin}\n{show}", typed)
    assert capsys.readouterr().out == "[{'fault': 'servo1.off', 'begun': True}]\n"
    for wrong in ("servo1.of", "servo9.off", "servo1.off"):
        check_refusal(*host.ask("POST", "/api/simulation/faults", {"fault": wrong}), status=422)
    exec(end, typed)
    assert host.get("/api/simulation/faults")["running"] == []
    check_refusal(*host.ask("DELETE", "/api/simulation/faults?fault=can.loss"), status=422)


@pytest.mark.slow
def test_a_trainer_exchanges_the_part_and_an_own_name_is_taught(connect) -> None:
    quick = BRISK | {"tactile__layout": COARSE_PADS, "sequence__force_n": [2.0, 3.0]}
    served, host = connect(cell={"model": None}, **quick)
    lease = host.post("/api/lease", name="trainer")["lease"]
    place = "/api/simulation/part"
    check_refusal(*host.ask("POST", place, {"lease": lease + 1, "part": "box"}), status=403)
    for part in ("dice", "mesh:file=/etc/passwd", "cylinder:diameter=8mm"):
        check_refusal(*host.ask("POST", place, {"lease": lease, "part": part}), status=422)
    assert host.ask("DELETE", f"/api/lease/{lease}")[0] == 200
    # The page from top to bottom, without the jobs of its first block; that gives its lease back.
    first, _, trainer = page_examples(host)
    typed: dict[str, Any] = {}
    exec(first.partition("\npart =")[0], typed)
    exec(first.splitlines()[-1], typed)
    exec(trainer, typed)
    lease = typed["lease"]
    assert "my mug" in host.get("/api/info")["labels"]
    placed = host.get(place)
    assert placed["part"] == placed["placed"] == "cylinder:diameter=8mm,length=20mm"
    assert (placed["pose"]["x_m"], "my mug" in placed["objects"]) == (0.002, True)
    assert served.ended(host.post("/api/simulation/reset", lease=lease)["job"]).error == ""
    placed = host.get(place)
    assert (placed["part"], placed["placed"], placed["pose"]["x_m"]) == (None, None, 0.0)


def test_the_view_only_link_reads_and_gives_no_command(served, host) -> None:
    interfaces = served.interfaces
    watcher = Client({"http_port": host.port, "token": interfaces["view_token"]})
    told = watcher.get("/api/access")
    assert told["address"] == f"http://127.0.0.1:{host.port}/#token={interfaces['view_token']}"
    assert (told["commands"], host.get("/api/access")["commands"]) == (False, True)
    assert "set serve.listen" in told["note"]
    assert {len(told["qr"])} == {len(row) for row in told["qr"]}
    with watcher.live() as link:
        assert json.loads(link.recv())["status"]["state"] == "IDLE"
    assert watcher.ask("POST", "/api/hold", {})[0] == 200


def test_a_cell_with_real_ports_has_no_faults_on_request(connect) -> None:
    served, host = connect(**REAL)
    assert not served.service.config.simulated
    for path in ("faults?fault=can.off", "part", "reset"):
        for way in ("GET", "POST", "DELETE"):
            body = {"fault": "can.off"} if way == "POST" else None
            check_refusal(*host.ask(way, f"/api/simulation/{path}", body), status=404)


def test_all_but_hold_and_health_needs_the_token(served, host) -> None:
    paths = host.ask("GET", "/openapi.json", token=None)[1]["paths"]
    guarded = [(path, method) for path, ways in paths.items() for method in ways]
    assert len(guarded) == 25
    for path, method in guarded:
        if path in ("/api/hold", "/healthz"):
            continue
        place = path.format(lease=1, number=1, label="ball")
        for token in (None, "wrong"):
            assert host.ask(method.upper(), place, {}, token=token)[0] == 401, path
        view = served.interfaces["view_token"]
        status, answer = host.ask(method.upper(), place, {}, token=view)
        assert (status == 403) is (method != "get"), path
        if status == 403:
            assert (answer["fault_number"], "is view only" in answer["error"]) == (514, True)


def test_the_description_has_a_text_for_each_path(host) -> None:
    described = host.ask("GET", "/openapi.json", token=None)[1]
    paths = described["paths"]
    assert all(way["description"] for ways in paths.values() for way in ways.values())
    start = paths["/api/jobs"]["post"]["requestBody"]["content"]["application/json"]
    examples = [one["value"] for one in start["examples"].values()]
    assert {checked_goal(one["goal"]).task for one in examples} == set(TASKS)
    schemas = described["components"]["schemas"]
    kinds = schemas["StartBody"]["properties"]["goal"]["oneOf"]
    assert [one["properties"]["task"]["const"] for one in kinds] == list(TASKS)
    assert all(
        field["description"]
        for kind in (*kinds, schemas["Pose"], schemas["RefusalBody"])
        for name, field in kind["properties"].items()
        if name != "task"
    )
    assert "HTTPValidationError" not in json.dumps(paths)


@pytest.mark.slow
def test_the_example_of_the_page_runs(served, host, capsys) -> None:
    exec(compile(page_examples(host)[0], "use-it-over-http.md", "exec"), {})
    assert [job.task for job in served.plugin.jobs()] == ["identify", "verify", "release", "sort"]
    assert "ball 0.9 sphere 9.5" in capsys.readouterr().out
    paths = host.ask("GET", "/openapi.json", token=None)[1]["paths"]
    described = {path.replace("{label:path}", "{label}") for path in paths}
    for path in re.findall(r"`(?:GET|POST|PUT|DELETE) ([a-z{][^`?]*)", PAGE.read_text("utf-8")):
        assert f"/api/{path.strip()}" in described, path


def page_examples(host: Client) -> list[str]:
    """Return the examples in Python of the page, with the address and token of this interface."""
    examples = blocks("how-to/use-it-over-http.md", "python")
    for there, here in (
        ("http://127.0.0.1:8080", f"http://127.0.0.1:{host.port}"),
        ("the token that serve prints", host.token),
    ):
        assert there in "".join(examples)
        examples = [example.replace(there, here) for example in examples]
    return examples


def test_a_defect_is_answered_in_the_same_shape(served, host, caplog) -> None:
    served.plugin.info = raising(ZeroDivisionError("a defect"))
    status, answer = host.ask("GET", "/api/info")
    check_refusal(status, answer, status=500)
    assert answer["fault_number"] == 599
    assert answer["error"] == "unexpected error (ZeroDivisionError): a defect"
    until(lambda: "a defect" in caplog.text)  # for those who mend it


def test_an_answer_may_take_longer_than_a_request(connect) -> None:
    served, host = connect(serve__request_timeout_s=0.1)
    taught, waited = served.plugin.taught, threading.Event()
    served.plugin.taught = lambda: waited.wait(0.3) or taught()
    assert len(host.get("/api/taught")) == 2


def test_a_page_from_elsewhere_is_refused(host) -> None:
    here = f"http://127.0.0.1:{host.port}"
    assert host.ask("POST", "/api/hold", {}, Origin=here)[0] == 200
    with host.live(origin=here) as link:
        assert json.loads(link.recv(timeout=20))["status"]["state"] == "IDLE"
    schemes = ("https", "file", "ws", "chrome-extension")
    others = [here.replace("http", scheme) for scheme in schemes]
    for origin in ("http://evil.example", "null", *others):
        assert host.ask("POST", "/api/hold", {}, Origin=origin)[0] == 403
        with pytest.raises(InvalidStatus, match="403"), host.live(origin=origin):
            pass
    with socket.create_connection(("127.0.0.1", host.port)) as link:
        link.sendall(
            f"POST /api/hold HTTP/1.1\r\nHost: 127.0.0.1:{host.port}\r\nContent-Length: 0\r\n"
            f"Origin: http://evil.example\r\nOrigin: {here}\r\n\r\n".encode()
        )
        assert link.recv(100).startswith(b"HTTP/1.1 403")
    # A name that leads here is not the name of this machine.
    here_by_another = socket.create_connection(("127.0.0.1", host.port))
    at = f"ws://evil.example:{host.port}/api/live?token={host.token}"
    with pytest.raises(InvalidStatus, match="403"), open_socket(at, sock=here_by_another):
        pass


def test_a_proxy_with_tls_serves_names_of_the_config(connect) -> None:
    _, host = connect(serve__hosts=["cell.lan"])
    for name, origin, status in (
        ("cell.lan", "https://cell.lan", 200),
        ("cell.lan:8443", "https://cell.lan:8443", 200),
        ("cell.lan", "file://cell.lan", 403),
        ("cell.lan", "https://cell.lan:8443", 403),
        ("localhost", "https://localhost", 403),
    ):
        assert host.ask("POST", "/api/hold", {}, Host=name, Origin=origin)[0] == status, origin


FORGED = {
    "X-Forwarded-For": "127.0.0.7",
    "X-Forwarded-Proto": "https",
    "Forwarded": "for=127.0.0.7;proto=https",
    "X-Real-IP": "127.0.0.7",
}
"""What a proxy adds to a request, or a client that wants to be another one."""


def test_a_client_that_names_another_address_stays_itself(serve) -> None:
    served = serve("http", "xmlrpc")
    for name in ("HTTP 127.0.0.7 gate", "XML-RPC 127.0.0.7"):
        served.service.begin_stop(name, name)
    both = served.service.held_by
    host = Client(served.interfaces)
    assert host.ask("POST", "/api/hold?latch=false&name=gate", token=None, **FORGED)[0] == 200
    host.port = served.interfaces["xmlrpc_port"]
    headers = FORGED | {"Content-Type": "text/xml"}
    assert host.send("POST", "/RPC2", xmlrpc_dumps((0,), "hold"), **headers)[0] == 200
    assert served.service.held_by == both


def test_the_second_request_of_a_connection_has_its_limit_too(connect, monkeypatch) -> None:
    monkeypatch.setitem(HttpServer.__init__.__kwdefaults__, "idle_s", 1)
    _, host = connect(serve__request_timeout_s=0.3)
    whole = b"POST /api/hold HTTP/1.1\r\nHost: localhost\r\n\r\n"
    with ExitStack() as undo:
        links = []
        for first, second in ((whole, whole[:-2]), (whole + whole[:-2], b"")):
            link = undo.enter_context(socket.create_connection(("127.0.0.1", host.port), 20.0))
            link.sendall(first)
            assert link.recv(1000).startswith(b"HTTP/1.1 200 ")
            link.sendall(second)
            links.append(link)
        for link in links:
            until(lambda link=link: ended(link))
    with host.live(additional_headers=FORGED) as live:
        for _ in range(20):  # a WebSocket has no such limit, behind a proxy either
            live.recv(timeout=20)


def test_the_socket_sends_states_and_frames(served, host) -> None:
    def frame(link: Any) -> Any:
        return until(lambda: isinstance(message := link.recv(timeout=20), bytes) and message)

    with host.live("&frames=1") as link, host.live("&frames=newtons") as newtons:
        assert json.loads(link.recv(timeout=20))["pose"] is None
        lease = host.post("/api/lease", name="host")["lease"]
        host.post("/api/jobs", lease=lease, goal={"task": "grip", "force_n": 3.0})
        served.ended()
        assert len(frame(link)) == 2 * 408
        assert np.frombuffer(frame(newtons), "<f4").shape == (408,)
        until(lambda: isinstance(m := link.recv(timeout=20), str) and "COMPLETE" in m)


def test_the_token_comes_as_subprotocol(host) -> None:
    at = f"ws://127.0.0.1:{host.port}/api/live"
    with open_socket(at, subprotocols=["tactile-cell", f"token.{host.token}"]) as link:
        assert link.subprotocol == "tactile-cell"
        assert "IDLE" in link.recv(timeout=20)
    for protocols in (["tactile-cell", "token.wrong"], ["tactile-cell"]):
        with pytest.raises(InvalidStatus, match="403"):
            open_socket(at, subprotocols=protocols)


@pytest.mark.slow
def test_a_socket_that_takes_nothing_is_cut(serve, monkeypatch) -> None:
    for name in ("_PEER_IDLE_S", "_PEER_ASKED_S", "_PEER_ASKED_MAX"):
        monkeypatch.setattr(f"cell.interfaces.access.{name}", 1)
    service = serve(serve__http_port=0, serve__request_timeout_s=0.3).service
    interface, link = WebInterface(service), socket.socket()
    link.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    link.connect(("127.0.0.1", interface.port))
    request = (
        f"GET /api/live?frames=newtons&token={interface.token} HTTP/1.1\r\nHost: localhost\r\n"
        "Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
        "Sec-WebSocket-Key: MDEyMzQ1Njc4OWFiY2RlZg==\r\n\r\n"
    )
    with closing(link), running(service, {"http_port": interface}):
        link.sendall(request.encode())
        links = interface._server.server_state.connections
        until(lambda: any("WebSocket" in type(one).__name__ for one in links))
        until(lambda: not links)


def test_the_end_of_the_interface_ends_sockets_and_threads() -> None:
    before = set(threading.enumerate())
    with ExitStack() as undo, Client(undo.enter_context(serving("http")).interfaces).live() as link:
        link.recv(timeout=20)
        undo.close()
        with pytest.raises(ConnectionClosed):
            deque(link)
    until(lambda: set(threading.enumerate()) <= before)


def test_tls_by_certificate_files(connect, tls, tmp_path) -> None:
    token = tmp_path / "token"
    token.write_text("a-token-of-the-operator\n")
    _, host = connect(**tls, serve__token_file=str(token))
    assert host.token == "a-token-of-the-operator"
    trusted = ssl.create_default_context(cafile=tls["serve__tls_certificate"])
    link = HTTPSConnection("127.0.0.1", host.port, timeout=20.0, context=trusted)
    link.request("GET", "/api/info", headers={"Authorization": f"Bearer {host.token}"})
    assert link.getresponse().status == 200
    link.close()
    link.request("PUT", "/api/info", headers={"Authorization": f"Bearer {host.token}"})
    assert link.getresponse().getheader("allow") == "GET"
    link.close()

    async def watch() -> None:
        url = f"wss://127.0.0.1:{host.port}/api/live?token=a-token-of-the-operator"
        async with open_in_one_thread(url, ssl=trusted) as live:
            for _ in range(20):
                assert json.loads(await live.recv())["status"]["state"] == "IDLE"

    # OpenSSL allows one thread at a time on a connection; the other client reads and writes in two.
    asyncio.run(asyncio.wait_for(watch(), 20.0))
