"""A simulated cell in a separate process: real time, pseudo-terminals, one socket."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from math import isfinite, nan
from pathlib import Path
from typing import Any

from cell.config.file import config_text
from cell.config.model import CellConfig
from cell.control.positioner import SocketPlacer
from cell.errors import CellError, PositionerError

_PROGRAM = "from cell.interfaces.cli import main; main()"
_SIMULATE = (sys.executable, "-P", "-c", _PROGRAM, "simulate", "--with-parent")
_START_S = 60.0
"""Longest start time of a simulated cell in s, on a busy machine."""
_REPLY_S = 10.0
"""Longest wait for a reply at its socket in s."""
_END_S = 5.0
"""Time in s for a process to end before it is killed."""
_LOOK_S = 0.02
"""Time in s between two looks at the process."""
_LOG_BYTES = 4000
"""Number of last bytes of a log in an error."""


class CellProcessError(CellError):
    """The simulated cell did not start, ended, or refused a request; its log is in the message."""


class AskedCell(ABC):
    """A simulated cell that takes requests, in another process or thread."""

    @property
    @abstractmethod
    def running(self) -> bool:
        """Whether it takes requests."""

    @abstractmethod
    def ask(self, **request: Any) -> dict[str, Any]:
        """Send a request, for example ``place="ball"`` or ``state=True``; return the reply."""

    def inject(self, text: str) -> "RequestedFault":
        """Inject a fault such as ``can.loss=0.05@2s``; raises as `ask` if it is refused."""
        self.ask(inject=text)
        return RequestedFault(self, text)

    def grip_n(self) -> float:
        """Return the true force in N on the pad with less force."""
        return float(min(self.ask(state=True)["contact_force_n"]))


class RequestedFault:
    """A fault in a cell that takes requests, in another process or thread."""

    def __init__(self, cell: AskedCell, text: str) -> None:
        self.text = text.strip()
        self._cell: AskedCell | None = cell

    @property
    def began_s(self) -> float | None:
        """Time in s at which it began, by the cell's clock; None before, NaN after its end.

        The clock of a process is the monotonic clock of this machine.
        """
        if self._cell is None or not self._cell.running:
            return nan
        began_s: float | None = self._cell.ask(state=True)["faults"].get(self.text, nan)
        return began_s

    def clear(self) -> None:
        """End the fault; the end of the cell ends it too."""
        began_s, cell, self._cell = self.began_s, self._cell, None
        if cell is not None and (began_s is None or isfinite(began_s)):
            cell.ask(clear=self.text)


class CellProcess(AskedCell):
    """A process ``tactile-cell simulate``, which this object starts and ends.

    Parameters
    ----------
    config
        The cell to simulate; its ports do not matter.
    report
        Gets the log at the end: its phase, its title and its text.

    Raises
    ------
    CellProcessError
        If it does not start.
    """

    def __init__(
        self, config: CellConfig, *, report: Callable[[str, str, str], object] = lambda *_: None
    ) -> None:
        self._report = report
        # The path of the socket must be short, so the folder of the test cannot be used.
        self._folder = tempfile.TemporaryDirectory(prefix="cell-")
        folder = Path(self._folder.name)
        config_path = folder / "simulate.yaml"
        config_path.write_text(config_text(config, comments=False), encoding="utf-8")
        self._log_path, announced = folder / "simulate.log", folder / "announced.json"
        with self._log_path.open("wb") as log, announced.open("wb") as line:
            self._process = subprocess.Popen(
                [*_SIMULATE, "-c", config_path, "--out", folder],
                stdin=subprocess.DEVNULL,
                stdout=line,
                stderr=log,
            )
        self._ended_by_us = False
        try:
            ports = self._announcement(announced)
            self.servo_port: str = ports["servo_port"]
            self.servo_baud_rate: int = ports["servo_baud_rate"]
            self.servo_ids: tuple[int, ...] = tuple(ports["servo_ids"])
            """The pseudo-terminal with the servos, its rate in bit/s, their IDs."""
            self.can_interface: str = ports["can_interface"]
            self.can_channel: str = ports["can_channel"]
            self.can_bitrate: int = ports["can_bitrate"]
            self.node_id: int = ports["node_id"]
            """The pseudo-terminal with the CAN adapter, for python-can, and the control unit's
            node."""
            self.positioner_socket: str = ports["positioner_socket"]
            """Unix socket for requests as JSON lines; `ask` sends them."""
            self.config_path = Path(ports["config"])
            """Config for programs that use this cell: ``tactile-cell run --config ...``."""
        except BaseException:
            self.end()
            raise

    @property
    def pid(self) -> int:
        """Number of the process."""
        return self._process.pid

    @property
    def running(self) -> bool:
        """Whether the process runs."""
        return self._process.poll() is None

    @property
    def log(self) -> str:
        """The last bytes of the standard error of the process."""
        with contextlib.suppress(OSError):
            return self._log_path.read_bytes()[-_LOG_BYTES:].decode(errors="replace")
        return ""

    def ask(self, **request: Any) -> dict[str, Any]:
        """Send a request, for example ``place="ball"`` or ``state=True``; return the reply.

        Raises
        ------
        CellProcessError
            If the request is refused, or the process is gone or does not answer.
        """
        try:
            return SocketPlacer(self.positioner_socket, timeout_s=_REPLY_S).ask(request)
        except PositionerError as error:
            raise CellProcessError(f"{request}: {error}. {self._state()}") from error

    def wait_for_grip(self, least_n: float, *, timeout_s: float = 30.0) -> float:
        """Wait until the force on both pads is ``least_n`` N, and return it.

        Raises
        ------
        TimeoutError
            If the force is not reached within ``timeout_s`` s.
        CellProcessError
            If the process is gone.
        """
        end_s = time.monotonic() + timeout_s
        while (grip_n := self.grip_n()) < least_n:
            if time.monotonic() > end_s:
                raise TimeoutError(f"{grip_n:.2f} N after {timeout_s:g} s, expected {least_n:g} N")
            time.sleep(_LOOK_S)
        return grip_n

    def kill(self) -> None:
        """Kill the process at once (SIGKILL), as by a loss of power."""
        self._ended_by_us = True
        self._process.kill()
        self._process.wait()

    def end(self) -> None:
        """End the process and remove its files.

        Raises
        ------
        CellProcessError
            If the process had ended by itself; the message has its exit code and log.
        """
        died, log = not self.running and not self._ended_by_us, self.log
        self._report("teardown", f"tactile-cell simulate {self.pid}", log)
        if self.running:
            self._ended_by_us = True
            os.kill(self.pid, signal.SIGCONT)  # the test may have stopped it
            self._process.terminate()
            try:
                self._process.wait(_END_S)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
        self._folder.cleanup()
        if died:
            raise CellProcessError(
                f"the simulated cell (process {self.pid}) ended by itself during the test with "
                f"exit code {self._process.returncode}; call kill() if the test should end it. "
                f"Its log:\n{log or '(empty)'}"
            )

    def _announcement(self, file: Path) -> dict[str, Any]:
        """Wait for the JSON line of a process that is ready for clients."""
        end_s = time.monotonic() + _START_S
        while not (line := file.read_bytes()).endswith(b"\n"):
            if not self.running:
                self._ended_by_us = True
                raise CellProcessError(f"the simulated cell did not start. {self._state()}")
            if time.monotonic() > end_s:
                raise CellProcessError(
                    f"the simulated cell was not ready after {_START_S:g} s. {self._state()}"
                )
            time.sleep(_LOOK_S)
        values: dict[str, Any] = json.loads(line)
        return values

    def _state(self) -> str:
        code = self._process.poll()
        state = "It runs" if code is None else f"It ended with exit code {code}"
        return f"{state} (process {self.pid}). Its log:\n{self.log or '(empty)'}"
