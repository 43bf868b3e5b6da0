"""`/healthz` and `/metrics`: a scrape of a simulated cell, read by Prometheus' own parser."""

import json
import re
import sys
from http.client import HTTPConnection
from types import SimpleNamespace

import pytest
from prometheus_client.parser import text_string_to_metric_families

from cell.control.answer import Answer
from cell.service.totals import Totals
from recognition.recognizer import UNKNOWN
from tactile.errors import HeartbeatLost
from tests import ROOT
from tests.cell.interfaces.hosts import Client
from tests.cell.served import Served

DASHBOARD = ROOT / "docs/examples/grafana-dashboard.json"
PAGE = ROOT / "docs/how-to/run-as-a-service.md"


def scraped(client: Client, token: str) -> tuple[int, str]:
    link = HTTPConnection("127.0.0.1", client.port, timeout=20.0)
    link.request("GET", "/metrics", headers={"Authorization": f"Bearer {token}"})
    answer = link.getresponse()
    found = answer.read().decode()
    link.close()
    return answer.status, found


def values_of(text: str) -> dict[str, float]:
    """Return each sample of a scrape, its labels in braces."""
    return {
        sample.name + "".join(f"{{{value}}}" for value in sample.labels.values()): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }


def test_a_scrape_counts_parts_faults_and_links(connect) -> None:
    served, client = connect(cell={})
    lease = client.post("/api/lease", name="host")["lease"]
    client.post("/api/jobs", lease=lease, goal={"task": "zero"})
    assert served.ended().error == ""
    goal = {"task": "sort", "parts": 2, "feed": ["ball", "box"], "max_grasps": 1}
    client.post("/api/jobs", lease=lease, goal=goal)
    ended = served.ended()
    assert ended.error == ""
    status, text = scraped(client, served.interfaces["view_token"])
    assert status == 200
    found = values_of(text)
    prefix = "tactile_cell_"
    names = {"ball": "{ball}{named}", "box": "{box}{named}", "reject": "{UNKNOWN}{unknown}"}
    places = {names[place]: n for place, n in ended.progress["places"].items() if n}
    prefixed = {key: n for key, n in found.items() if key.startswith(f"{prefix}parts_total")}
    assert prefixed == {f"{prefix}parts_total{key}": n for key, n in places.items()}
    assert sum(places.values()) == 2
    assert places["{box}{named}"] == 1
    assert found[f"{prefix}cycle_seconds_count"] == 2
    assert 1.0 < found[f"{prefix}cycle_seconds_sum"] < 60.0
    assert found[f"{prefix}force_error_newtons_count"] >= 2
    assert found[f"{prefix}force_error_newtons_bucket{{0.5}}"] >= 2
    assert found[f"{prefix}frames_total"] > 50
    assert found[f"{prefix}packets_total"] > 300
    assert (found[f"{prefix}state"], found[f"{prefix}fault"]) == (4, 0)
    assert 10 < found[f"{prefix}servo_temperature_celsius{{0}}"] < 80
    assert found[f"{prefix}disk_free_bytes"] > 0
    assert found[f"{prefix}loop_lateness_seconds{{0.99}}"] >= 0
    assert {f"{prefix}drift_gain_ratio", f"{prefix}drift_zero_metres"} <= found.keys()
    check_drives(served, found)
    check_dashboard(found)
    with served.service._lock:
        client.ask("POST", "/api/simulation/faults", {"fault": "servo1.off"})
    client.post("/api/jobs", lease=lease, goal={"task": "grip", "force_n": 3.0})
    number = served.ended().fault_number
    found = values_of(scraped(client, client.token)[1])
    assert found[f"{prefix}faults_total{{{number}}}"] == 1
    assert found[f"{prefix}fault"] == number


def check_drives(served: Served, found: dict[str, float]) -> None:
    """Check that what the self-zero has measured of each servo is in the scrape."""
    for number, drive in enumerate(served.plugin._cell.controller.zeroing.drives.values()):
        name = "tactile_cell_servo_{}".format
        assert drive.measured_s == found[f"{name('measured_seconds')}{{{number}}}"] > 1e9
        assert drive.breakaway_a == found[f"{name('friction_amperes')}{{{number}}}"]
        slopes = [found[f"{name('amperes_per_newton_metre')}{{{direction}}}{{{number}}}"]
                  for direction in ("rising", "falling")]  # fmt: skip
        assert slopes == [drive.rising_a_nm, drive.falling_a_nm]
        constant = found[f"{name('motor_constant_newton_metres_per_ampere')}{{{number}}}"]
        assert constant == drive.kt_nm_a
    assert number == 1


def check_dashboard(found: dict[str, float]) -> None:
    """Check that each metric of the dashboard is in the scrape; a fault may not be there yet."""
    dashboard = json.loads(DASHBOARD.read_text())
    used = {
        name
        for panel in dashboard["panels"]
        for target in panel["targets"]
        for name in re.findall(r"tactile_cell_\w+", target["expr"])
    }
    there = {name.partition("{")[0] for name in found} | {"tactile_cell_faults_total"}
    assert len(used) > 20
    assert used <= there
    documented = re.findall(r"`(tactile_cell_\w+)`", PAGE.read_text("utf-8"))
    samples = re.compile(r"(_total|_bucket|_count|_sum|_created)$")
    families = {samples.sub("", name) for name in there}
    assert {samples.sub("", name) for name in documented} == families


def test_each_result_of_a_part_is_counted() -> None:
    totals = Totals()
    record = SimpleNamespace(
        cycles=(SimpleNamespace(setpoint_n=5.0),), outcome=SimpleNamespace(final_force_n=4.7)
    )
    found = SimpleNamespace(records=(record, record))
    for label, rejected in (("ball", False), ("ball", True), (UNKNOWN, True)):
        totals.add(Answer(label=label, rejected=rejected, seconds=70.0), found)
    totals.add(Answer(seconds=70.0), None)
    assert dict(totals.parts) == {
        ("ball", "named"): 1,
        ("ball", "rejected"): 1,
        (UNKNOWN, "unknown"): 1,
        ("", "missed"): 1,
    }
    assert list(totals.cycles_s.cumulated())[-2:] == [(60.0, 0), (float("inf"), 3)]
    assert dict(totals.force_errors_n.cumulated())[0.5] == 6
    assert totals.force_errors_n.sum == pytest.approx(1.8)


def test_metrics_need_a_token_and_health_does_not(connect) -> None:
    served, client = connect()
    assert scraped(client, "wrong")[0] == 401
    well = {"working": True, "problem": "", "state": "IDLE", "fault_number": 0, "holding": False}
    assert client.ask("GET", "/healthz", token=None) == (200, well)
    served.plugin.fail(HeartbeatLost("no heartbeat"))
    status, found = client.ask("GET", "/healthz", token=None)
    assert (status, found["state"], found["fault_number"]) == (200, "ABORTED", 305)
    served.plugin.working = False
    status, found = client.ask("GET", "/healthz", token=None)
    assert (status, found["problem"].split(";")[0]) == (503, "the thread of the cell hangs")


def test_without_its_extra_a_scrape_says_what_to_install(connect, monkeypatch) -> None:
    _, client = connect()
    monkeypatch.delitem(sys.modules, "cell.interfaces.metrics", raising=False)
    monkeypatch.setitem(sys.modules, "prometheus_client", None)
    status, text = scraped(client, client.token)
    assert status == 422
    assert "/metrics needs prometheus_client; install this project with its extra" in text
