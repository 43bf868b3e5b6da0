"""A person at a pseudo-terminal: reads what a program prints, and types."""

import os
import pty
import re
import select
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path

_PROGRAM = (
    "import fcntl, termios; fcntl.ioctl(0, termios.TIOCSCTTY, 0); "
    "from cell.interfaces.cli import main; main()"
)
"""The terminal becomes the program's own, so that Ctrl-C reaches it."""
_CONTROL = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]|\r")
Act = Callable[[], object]


class Person:
    """Runs ``tactile-cell`` on a pseudo-terminal and answers its questions.

    Parameters
    ----------
    arguments
        Of the command line.
    folder
        Working directory.
    """

    def __init__(self, arguments: list[str], folder: Path) -> None:
        master, slave = pty.openpty()
        environment = os.environ | {"TERM": "xterm", "COLUMNS": "200", "LINES": "50"}
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-c", _PROGRAM, *arguments],
            stdin=slave,
            stdout=slave,
            stderr=slave,
            cwd=folder,
            env=environment,
            start_new_session=True,
        )
        os.close(slave)
        self._master = master
        self.text = ""
        self._read_to = 0

    def type(self, text: str) -> None:
        """Type a text; what ends it is typed too."""
        os.write(self._master, text.encode())

    def meet(
        self, answers: Mapping[str, str | Act | tuple[Act, str]], *, timeout_s: float = 60.0
    ) -> int:
        """Answer each question as its text is seen, until the program ends; return its exit code.

        An answer is typed with Enter; hands (a function) act first and confirm with Enter, or with
        the text beside them. A function that raises StopIteration ends the meeting, and -1 is
        returned: the program still runs.
        """
        end_s = time.monotonic() + timeout_s
        while time.monotonic() < end_s:
            if not self._more(0.2):
                return self._process.wait(10.0)
            fresh = self.text[self._read_to :]
            found = [(fresh.rfind(key), key) for key in answers if key in fresh]
            if not found:
                continue
            at, key = max(found)
            # The whole question has to be there.
            if not re.search(r"> $|Enter: |leave: $", fresh[at:]):
                continue
            self._read_to = len(self.text)
            answer = answers[key]
            act, typed = answer if isinstance(answer, tuple) else (answer, "")
            try:
                typed = act if isinstance(act, str) else (act(), typed)[1]
            except StopIteration:
                return -1
            self.type(typed if typed.endswith("\x03") else f"{typed}\n")
        raise TimeoutError(f"no end after {timeout_s:g} s; it printed:\n{self.text[-3000:]}")

    def _more(self, timeout_s: float) -> bool:
        """Read what is printed; False once the program has closed its terminal."""
        if not select.select([self._master], [], [], timeout_s)[0]:
            return True
        try:
            data = os.read(self._master, 65536)
        except OSError:
            return False
        self.text += _CONTROL.sub("", data.decode(errors="replace"))
        return bool(data)

    def hang_up(self) -> int:
        """Close the terminal's window; return the exit code of the program."""
        self._process.send_signal(signal.SIGHUP)
        end_s = time.monotonic() + 20.0
        while self._more(0.2) and self._process.poll() is None:
            assert time.monotonic() < end_s, self.text
        return self._process.wait(10.0)

    def close(self) -> None:
        """End the program where it still runs, and give the terminal back."""
        if self._process.poll() is None:
            self._process.kill()
            self._process.wait()
        os.close(self._master)
