"""Runs the URScript of the example as Python; `end`, `thread`, `run`, `kill` and `p[]` differ."""

import re
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xmlrpc.client import ServerProxy

SCRIPT = Path(__file__).parents[3] / "docs" / "examples" / "tactile_cell.script"


class Robot:
    """A robot that runs the script: its motions and messages are noted."""

    def __init__(self, address: str) -> None:
        self.moves: list[Any] = []
        self.messages: list[Any] = []
        self.calls: list[str] = []
        self._over = threading.Event()
        self._threads: list[threading.Thread] = []
        self._links: list[ServerProxy] = []
        self.names: dict[str, Any] = {
            "rpc_factory": self._rpc,
            "movel": lambda pose, **_limits: self.moves.append(pose),
            "pose_trans": lambda base, offset: (base, offset),
            "pose_inv": lambda pose: pose,
            "textmsg": lambda *text: self.messages.append(text),
            "sleep": lambda _s: self._over.wait(0.01),
            "run": self._run,
            "kill": lambda _heart: self._over.set(),
        }
        text = re.sub(r"^(\s*)global (\w+) =", r"\1\2 =", SCRIPT.read_text(), flags=re.M)
        text = re.sub(r"^ *end$", "", text, flags=re.M)
        text = re.sub(r"^thread ", "def ", text, flags=re.M).replace("= p[", "= [")
        text = re.sub(r"\bp\[", "[", text)
        text = re.sub(r"\brun (\w+)\(\)", r"run(\1)", text)
        text = re.sub(r"\bkill (\w+)", r"kill(\1)", text)
        text = text.replace("while True:", "while not over():")
        text = re.sub(r"(def connect\(\):)", r"\1\n  global cell, alive_line, lease", text)
        self.names["over"] = self._over.is_set
        exec(compile(text, str(SCRIPT), "exec"), self.names)
        self.names["ADDRESS"] = address

    def sort_parts(self, parts: int) -> int:
        return self.names["sort_parts"](parts)

    def close(self) -> None:
        self._over.set()
        for thread in self._threads:
            thread.join()
        for link in self._links:
            link("close")()

    def _run(self, thread: Callable[[], None]) -> None:
        self._threads.append(threading.Thread(target=thread, daemon=True))
        self._threads[-1].start()

    def _rpc(self, kind: str, address: str) -> Any:
        assert kind == "xmlrpc"
        link = ServerProxy(address)
        self._links.append(link)
        robot = self

        class Handle:
            def __getattr__(self, name: str) -> Callable[..., Any]:
                def call(*arguments: Any) -> Any:
                    robot.calls.append(name)
                    return getattr(link, name)(*arguments)

                return call

        return Handle()
