"""Each part of a sort as hosts see it, beside the tally of the sort: once, and with all it has."""

import json
import threading
from contextlib import closing
from typing import Any
from xmlrpc.client import ServerProxy

from cell.control.answer import Answer
from cell.jobs.sort import Tally
from tests.cell.interfaces.hosts import BlockPlc, Client, Plc
from tests.waiting import LIMIT_S

N_PARTS = 4
IDS = {"box": 1, "ball": 2}
PLACES = ("ball", "box", "reject")
SORT = 24


def seen_over_xml_rpc(cell: ServerProxy, over: threading.Event) -> list[dict[str, Any]]:
    """Ask for the newest part until the sort is over; return what the cell answers of each."""
    parts: list[dict[str, Any]] = []
    while len(parts) < N_PARTS and not over.wait(0.02):
        for number in range(len(parts) + 1, cell.part() + 1):
            names = ("label", "label_id", "probability", "size", "place", "place_id")
            found = {name: getattr(cell, f"part_{name}")(number) for name in names}
            parts.append({"number": number} | found)
    return parts


def events(link: Any) -> list[dict[str, Any]]:
    """Return the parts that the WebSocket sends as events."""
    parts: list[dict[str, Any]] = []
    while len(parts) < N_PARTS:
        message = json.loads(link.recv(LIMIT_S))
        if message.get("event") == "part":
            parts.append(message["part"])
        else:
            assert len(message["shift"]["answers"]) <= len(parts), "the event comes first"
    return parts


def test_each_part_of_a_sort_reaches_plc_robot_and_program_once(serve, monkeypatch) -> None:
    parts: list[Answer] = []
    count = Tally.add

    def add(tally: Tally, part: Answer) -> None:
        parts.append(part)
        count(tally, part)

    monkeypatch.setattr(Tally, "add", add)
    served = serve("modbus", "xmlrpc", "http", cell={}, serve__objects=["box", "ball"])
    host = Client(served.interfaces)
    cell = ServerProxy(f"http://127.0.0.1:{served.interfaces['xmlrpc_port']}/RPC2")
    plc = BlockPlc(Plc(served.interfaces["modbus_port"])).ready()
    over, over_rpc = threading.Event(), list[Any]()
    robot = threading.Thread(target=lambda: over_rpc.extend(seen_over_xml_rpc(cell, over)))
    with cell, host.live("&parts_after=0") as link, closing(plc.plc.link):
        robot.start()
        try:
            assert plc.run(SORT, Object=N_PARTS, MaxGrasps=1) == (True, 0)
            plc.cycle()
            sent = events(link)
            robot.join(LIMIT_S)
        finally:
            over.set()
        assert cell.label(1) == sent[-1]["label"]
    expected = [
        {
            "number": number,
            "label": part.label,
            "label_id": IDS.get(part.label, 0),
            "probability": part.probability,
            "place": part.place,
            "place_id": PLACES.index(part.place) + 1,
        }
        for number, part in enumerate(parts, start=1)
    ]
    assert len({part.label for part in parts}) > 1
    sizes_mm = [part["size_mm"] for part in sent]
    assert all(5.0 < size_mm < 20.0 for size_mm in sizes_mm)
    assert [{name: part[name] for name in expected[0]} for part in sent] == expected
    assert sent == host.get("/api/state")["shift"]["answers"]
    assert over_rpc == [
        one | {"size": size_mm} for one, size_mm in zip(expected, sizes_mm, strict=True)
    ]
    assert plc.parts == [
        {
            "Number": one["number"],
            "LabelId": one["label_id"],
            "Probability": round(1e4 * one["probability"]),
            "Size": round(100 * size_mm),
            "Place": one["place_id"],
            "Label": one["label"],
            "PlaceName": one["place"],
        }
        for one, size_mm in zip(expected, sizes_mm, strict=True)
    ]
