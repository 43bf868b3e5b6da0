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
_CONTROL = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]|\x1b[78]|\r")
Answer = str | Callable[[re.Match[str]], object]


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

    def meet(self, answers: Mapping[str, Answer], *, timeout_s: float = 60.0) -> int:
        """Answer each question as its text is seen, until the program ends; return its exit code.

        Parameters
        ----------
        answers
            What is typed, with Enter, by a pattern of the question; or hands that act, given the
            match, and return what is typed then (Enter alone for None). A pattern that begins with
            ``!`` is no question: hands act and nothing is typed. Hands that raise StopIteration end
            the meeting; -1 is returned then, and the program still runs.
        timeout_s
            Longest time in s without anything to answer.
        """
        end_s = time.monotonic() + timeout_s
        while time.monotonic() < end_s:
            if not self._more(0.2):
                return self._process.wait(10.0)
            fresh = self.text[self._read_to :]
            found = [
                (match.start(), pattern.startswith("!"), match, answers[pattern])
                for pattern in answers
                for match in re.finditer(pattern.removeprefix("!"), fresh)
            ]
            if not found:
                continue
            at, seen, match, answer = max(found, key=lambda one: one[0])
            # The whole question has to be there.
            if not seen and not re.search(r"> |leave: $", fresh[at:]):
                continue
            self._read_to += match.end() if seen else len(fresh)
            end_s = time.monotonic() + timeout_s
            try:
                typed = answer if isinstance(answer, str) else answer(match)
            except StopIteration:
                return -1
            except AssertionError as error:
                raise AssertionError(f"{error}:\n{self.text[-3000:]}") from error
            if not seen:
                typed = typed if isinstance(typed, str) else ""
                self.type(typed if typed.endswith("\x03") else f"{typed}\n")
        shown = re.sub(r"(.{8,80}?)\1+", r"\1", self.text)
        raise TimeoutError(f"no end after {timeout_s:g} s; it printed:\n{shown[-3000:]}")

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
