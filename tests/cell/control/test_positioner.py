import json
import socket
import threading
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path

import pytest

from cell.control.plan import Pose
from cell.control.positioner import (
    CallbackPositioner,
    OperatorPositioner,
    SimulatedPositioner,
    SocketPlacer,
)
from cell.errors import PositionerError
from tests.values import raising

POSE = Pose(x_m=1e-3, rotation_rad=1.0)


class Table:
    def __init__(self) -> None:
        self.placed: list[tuple[str, Pose]] = []

    def check(self, label: str) -> None:
        if label != "ball":
            raise PositionerError(f"there is no object {label!r}; there are ball")

    def place(self, label: str, pose: Pose) -> Pose:
        self.placed.append((label, pose))
        return Pose(x_m=pose.x_m)


def test_simulated_positioner_places_the_presented_object_and_says_where_it_rests() -> None:
    table = Table()
    positioner = SimulatedPositioner(table)
    with pytest.raises(PositionerError, match="no object was named"):
        positioner.move_to(POSE)
    positioner.present("ball")
    with pytest.raises(PositionerError, match="'washer'; there are ball"):
        positioner.present("washer")
    positioner.present(None)
    assert positioner.move_to(POSE) == Pose(x_m=1e-3)
    assert table.placed == [("ball", POSE)]


def test_operator_is_asked_and_can_stop() -> None:
    asked: list[str] = []
    answers = iter(["", "", "q"])

    def ask(text: str) -> str:
        asked.append(text)
        return next(answers)

    positioner = OperatorPositioner(ask)
    positioner.present("ball")
    assert positioner.move_to(POSE) == POSE
    assert "'ball'" in asked[0]
    assert "x +1.0 mm" in asked[1]
    with pytest.raises(PositionerError, match="operator stopped"):
        positioner.present(None)


def test_operator_who_is_not_there_is_an_error() -> None:
    with pytest.raises(PositionerError, match="no operator"):
        OperatorPositioner(raising(EOFError())).move_to(POSE)


OTHER = Pose(y_m=2e-3)


@pytest.mark.parametrize(
    ("answer", "reached"),
    [
        *((None, POSE), (True, POSE), (OTHER, OTHER), (False, "host refused")),
        *((wrong, "the host answered") for wrong in (0, 1, "yes")),
    ],
)
def test_host_moves_or_refuses(answer, reached: Pose | str) -> None:
    positioner = CallbackPositioner(lambda _pose: answer)
    positioner.present("ignored")
    if isinstance(reached, Pose):
        assert positioner.move_to(POSE) == reached
    else:
        with pytest.raises(PositionerError, match=reached):
            positioner.move_to(POSE)


@pytest.fixture
def serve(tmp_path: Path) -> Iterator[Callable[[list[bytes]], str]]:
    threads: list[threading.Thread] = []

    def start(replies: list[bytes]) -> str:
        path = str(tmp_path / "s")
        listener = socket.socket(socket.AF_UNIX)
        listener.bind(path)
        listener.listen(1)

        def run() -> None:
            with listener, listener.accept()[0] as peer, peer.makefile("rb") as lines:
                for reply in replies:
                    lines.readline()
                    peer.sendall(reply)

        threads.append(threading.Thread(target=run))
        threads[-1].start()
        return path

    yield start
    for thread in threads:
        thread.join(10.0)


def test_socket_placer_speaks_json_lines(serve: Callable[[list[bytes]], str]) -> None:
    reply = json.dumps({"ok": True, "pose": asdict(Pose(x_m=3e-3))}).encode() + b"\n"
    placer = SocketPlacer(serve([reply, b'{"error": "no such object"}\n', b"nonsense\n"]))
    assert placer.place("ball", POSE) == Pose(x_m=3e-3)
    with pytest.raises(PositionerError, match="no such object"):
        placer.place("x", POSE)
    with pytest.raises(PositionerError, match="lost"):
        placer.place("x", POSE)
    with pytest.raises(PositionerError, match=r"closed|lost"):
        placer.place("x", POSE)
    placer.close()


def test_socket_without_a_simulator_is_a_clear_error(tmp_path: Path) -> None:
    with pytest.raises(PositionerError, match="no simulated cell answers"):
        SocketPlacer(str(tmp_path / "none"))


@pytest.mark.parametrize(
    "reply",
    [
        b'{"ok": true}\n',
        b'{"pose": [1, 2]}\n',
        b'{"pose": {"x_m": "far"}}\n',
        b'{"pose": {"x_m": NaN, "y_m": 0, "rotation_rad": 0, "roll_rad": 0}}\n',
        b"[" * 20_000 + b"\n",
        b"x" * 70_000,
        b"\xff\xfe\n",
    ],
)
def test_a_reply_that_is_none_is_refused(serve: Callable[[list[bytes]], str], reply: bytes) -> None:
    placer = SocketPlacer(serve([reply]))
    with pytest.raises(PositionerError, match="simulated cell at"):
        placer.place("ball", POSE)
    placer.close()


def test_a_reply_that_does_not_end_is_not_waited_for(tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(tmp_path / "s"))
        listener.listen(1)
        placer = SocketPlacer(str(tmp_path / "s"), timeout_s=0.05)
        with listener.accept()[0] as peer:
            peer.sendall(b"{")
            for _ in range(2):
                with pytest.raises(PositionerError, match="is lost"):
                    placer.place("ball", POSE)
