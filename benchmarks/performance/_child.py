"""A simulated device as a child process at a pseudo-terminal; its orders are lines of JSON."""

import json
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

_END_S = 10.0


class Child:
    """The other end of a module that is run as a program.

    Attributes
    ----------
    port
        Path of the pseudo-terminal that it serves.
    """

    def __init__(self, process: "subprocess.Popen[str]") -> None:
        self._process = process
        self.port: str = json.loads(self._line())["port"]

    def _line(self) -> str:
        text = self._process.stdout.readline()
        if not text:
            raise RuntimeError(f"{' '.join(map(str, self._process.args))} has ended")
        return text

    def order(self, **wish: Any) -> None:
        """Tell it something; returns when it has been carried out."""
        print(json.dumps(wish), file=self._process.stdin, flush=True)
        self._line()


_Kind = TypeVar("_Kind", bound=Child)


@contextmanager
def running(kind: type[_Kind], module: str) -> Iterator[_Kind]:
    """Run a module as a program while the context lasts; it ends when its input does."""
    with subprocess.Popen(
        [sys.executable, "-m", module],
        cwd=Path(__file__).resolve().parents[2],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as process:
        try:
            yield kind(process)
        finally:
            process.stdin.close()
            process.wait(_END_S)
