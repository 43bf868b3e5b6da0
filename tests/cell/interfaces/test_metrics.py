"""`/healthz` and `/metrics`: a scrape of a simulated cell, read by Prometheus' own parser."""

import json
import re
import sys
from types import SimpleNamespace

import pytest
from prometheus_client.parser import text_string_to_metric_families

from cell.control.answer import Answer
from cell.control.zeroing import Zeroing
from cell.service.totals import Totals
from gripper.dynamixel.drive import DriveCharacteristic
from recognition.recognizer import UNKNOWN
from tactile.errors import HeartbeatLost
from tests import ROOT
from tests.cell.interfaces.hosts import Client

DASHBOARD = ROOT / "docs/examples/grafana-dashboard.json"
PAGE = ROOT / "docs/how-to/run-as-a-service.md"


def scraped(client: Client, token: str) -> tuple[int, str]:
    status, found, _ = client.send("GET", "/metrics", token=token)
    return status, found.decode() if isinstance(found, bytes) else str(found)


def values_of(text: str) -> dict[str, float]:
    """Return each sample of a scrape, its labels in braces."""
    return {
        sample.name + "".join(f"{{{value}}}" for value in sample.labels.values()): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }


@pytest.mark.slow
def test_a_scrape_counts_parts_faults_and_links(connect, monkeypatch) -> None:
    served, client = connect(cell={})
    lease = client.post("/api/lease", name="host")["lease"]
    drive = DriveCharacteristic(
        coulomb_a=0.1,
        breakaway_a=0.2,
        rising_a_nm=0.6,
        falling_a_nm=0.4,
        kt_nm_a=1.6,
        measured_s=1.0,
    )
    monkeypatch.setattr(Zeroing, "drives", {1: drive, 2: drive})
    goal = {"task": "sort", "parts": 1, "feed": ["box"], "max_grasps": 1}
    client.post("/api/jobs", lease=lease, goal=goal)
    assert served.ended().error == ""
    status, text = scraped(client, served.interfaces["view_token"])
    assert status == 200
    found = values_of(text)
    counted = {"parts_total{box}{named}": 1, "cycle_seconds_count": 1, "fault": 0, "state": 4}
    assert {name: found[f"tactile_cell_{name}"] for name in counted} == counted
    for name, least, most in (
        ("cycle_seconds_sum", 0.5, 60),
        ("force_error_newtons_count", 1, 10),
        ("frames_total", 50, 1e5),
        ("packets_total", 300, 1e6),
        ("servo_temperature_celsius{1}", 10, 80),
        ("disk_free_bytes", 1, 1e18),
        ("loop_lateness_seconds{0.99}", 0, 1),
        ("drift_gain_ratio", 0.5, 2),
        ("drift_zero_metres", -1e-2, 1e-2),
    ):
        assert least <= found[f"tactile_cell_{name}"] <= most, name
    for name, value in (
        ("measured_seconds", drive.measured_s),
        ("friction_amperes", drive.breakaway_a),
        ("amperes_per_newton_metre{rising}", drive.rising_a_nm),
        ("amperes_per_newton_metre{falling}", drive.falling_a_nm),
        ("motor_constant_newton_metres_per_ampere", drive.kt_nm_a),
    ):
        assert found[f"tactile_cell_servo_{name}{{1}}"] == value
    check_dashboard(found)
    served.plugin.simulate({"inject": "servo1.off"})
    client.post("/api/jobs", lease=lease, goal={"task": "grip", "force_n": 3.0})
    number = served.ended().fault_number
    found = values_of(scraped(client, client.token)[1])
    assert found[f"tactile_cell_faults_total{{{number}}}"] == 1
    assert found["tactile_cell_fault"] == number


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
