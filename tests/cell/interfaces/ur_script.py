"""Runs the URScript of the example as Python; `end`, `thread`, `run`, `kill` and `p[]` differ."""

import ast
import builtins
import re
import socket
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit
from xmlrpc.client import ServerProxy

SCRIPT = Path(__file__).parents[3] / "docs" / "examples" / "tactile_cell.script"


def _with_globals(function: re.Match[str]) -> str:
    """Return a function that declares the globals it sets, as Python wants it."""
    names = sorted(set(re.findall(r"^ +global (\w+) =", function[2], flags=re.M)))
    declared = f"  global {', '.join(names)}\n" if names else ""
    return f"\n{function[1]}{declared}{function[2]}end\n"


def _check_declared(tree: ast.Module, known: set[str]) -> None:
    """Fail where a function uses a name that no line above it has declared."""
    for statement in tree.body:
        if isinstance(statement, ast.Assign):
            known |= {one.id for one in statement.targets if isinstance(one, ast.Name)}
        elif isinstance(statement, ast.FunctionDef):
            known.add(statement.name)
            used = [one for one in ast.walk(statement) if isinstance(one, ast.Name)]
            local = {one.id for one in used if isinstance(one.ctx, ast.Store)}
            local |= {one.arg for one in statement.args.args}
            unknown = {one.id for one in used} - local - known
            assert not unknown, (statement.name, unknown)


class Robot:
    """A robot that runs the script: its motions and messages are noted."""

    def __init__(self, address: str) -> None:
        self.moves: list[Any] = []
        self.messages: list[Any] = []
        self.calls: list[str] = []
        self.answers: dict[str, Any] = {}
        """Answers by method that take the place of the cell's."""
        self.slept: Callable[[float], None] = lambda _s: None
        self._sockets: dict[str, socket.socket] = {}
        self._over = threading.Event()
        self._threads: list[threading.Thread] = []
        self._links: list[ServerProxy] = []
        self.names: dict[str, Any] = {
            "rpc_factory": self._rpc,
            "movel": lambda pose, **_limits: self.moves.append(pose),
            "pose_trans": lambda base, offset: (base, offset),
            "pose_inv": lambda pose: pose,
            "textmsg": lambda *text: self.messages.append(text),
            "sleep": self._sleep,
            "socket_open": self._socket_open,
            "socket_close": lambda name: self._sockets.pop(name).close(),
            "run": self._run,
            "kill": lambda _heart: self._over.set(),
        }
        text = re.sub(r"\n(def .*\n)((?:.*\n)*?)end\n", _with_globals, SCRIPT.read_text())
        text = re.sub(r"^(\s*)global (\w+) =", r"\1\2 =", text, flags=re.M)
        text = re.sub(r"^ *end$", "", text, flags=re.M)
        text = re.sub(r"^thread ", "def ", text, flags=re.M).replace("= p[", "= [")
        text = re.sub(r"\bp\[", "[", text)
        text = re.sub(r"\brun (\w+)\(\)", r"run(\1)", text)
        text = re.sub(r"\bkill (\w+)", r"kill(\1)", text)
        text = text.replace("while True:", "while not over():")
        self.names["over"] = self._over.is_set
        text = re.sub(r"^ADDRESS = .*", f'ADDRESS = "{address}"', text, flags=re.M)
        tree = ast.parse(text)
        _check_declared(tree, {*self.names, *dir(builtins)})
        exec(compile(tree, str(SCRIPT), "exec"), self.names)
        self.names["HOST"], self.names["PORT"] = "127.0.0.1", urlsplit(address).port

    def sort_parts(self, parts: int) -> int:
        return self.names["sort_parts"](parts)

    def close(self) -> None:
        self._over.set()
        for thread in self._threads:
            thread.join()
        for link in self._links:
            link("close")()

    def _sleep(self, time_s: float) -> None:
        self.slept(time_s)
        self._over.wait(0.01)

    def _socket_open(self, host: str, port: int, name: str) -> bool:
        try:
            self._sockets[name] = socket.create_connection((host, port), 20.0)
        except OSError:
            return False
        return True

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
                    found = getattr(link, name)(*arguments)
                    return robot.answers.get(name, found)

                return call

        return Handle()
