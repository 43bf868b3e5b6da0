"""Each part as hosts see it: once, and with all it has."""

import json
from contextlib import closing
from typing import Any
from xmlrpc.client import ServerProxy

import pytest

from cell.control.answer import Answer
from recognition.recognizer import UNKNOWN
from tests.cell.interfaces.hosts import BlockPlc, Client, Plc
from tests.cell.stub_plugin import ROUND
from tests.waiting import LIMIT_S

PLACES = ("ball", "box", "reject")


@pytest.mark.slow
def test_each_part_reaches_plc_robot_and_program_once(serve) -> None:
    served = serve("modbus", "xmlrpc", "http", serve__objects=["box", "ball"])
    plc = BlockPlc(Plc(served.interfaces["modbus_port"])).ready()
    cell = ServerProxy(f"http://127.0.0.1:{served.interfaces['xmlrpc_port']}/RPC2")
    host = Client(served.interfaces)
    sent: list[dict[str, Any]] = []
    with cell, host.live("&parts_after=0") as link, closing(plc.plc.link):
        for number, (label, label_id, place_id) in enumerate(
            (("ball", 2, 1), ("box", 1, 2), (UNKNOWN, 0, 3)), start=1
        ):
            place, probability = PLACES[place_id - 1], 0.9 - 0.01 * number
            part = Answer(
                task="sort",
                label=label,
                probabilities={label: probability},
                shape=ROUND,
                place=place,
                place_id=place_id,
                rejected=place == "reject",
            )
            served.plugin.on_part(part, None)
            plc.cycle()
            names = {"label": label, "label_id": label_id, "place": place, "place_id": place_id}
            assert cell.part() == number
            for name, value in (names | {"probability": probability, "size": 9.5}).items():
                assert getattr(cell, f"part_{name}")(number) == value
            while len(sent) < number:
                message = json.loads(link.recv(LIMIT_S))
                if message.get("event") == "part":
                    sent.append(message["part"])
                else:  # the event comes first
                    assert len(message["shift"]["answers"]) <= len(sent)
            shown = names | {"number": number, "probability": probability, "size_mm": 9.5}
            assert {name: sent[-1][name] for name in shown} == shown
            assert plc.cycle()["NewPart"] is False
            assert plc.parts[number - 1 :] == [
                {
                    "Number": number,
                    "LabelId": label_id,
                    "Probability": round(1e4 * probability),
                    "Size": 950,
                    "Place": place_id,
                    "Label": label,
                    "PlaceName": place,
                }
            ]
        assert sent == host.get("/api/state")["shift"]["answers"]
