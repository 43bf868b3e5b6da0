"""A supervisor that runs a unit file as systemd does: readiness, kill mode, restart."""

import os
import signal
import socket
import subprocess
import threading
import time
from contextlib import suppress
from pathlib import Path

TURN_S = 0.02


def read_unit(text: str) -> dict[str, str]:
    """Return the last value of each key."""
    lines = (line.partition("=") for line in text.splitlines())
    return {key: value for key, equals, value in lines if equals and key.isalpha()}


class Supervisor(threading.Thread):
    """Keeps the service of a unit running until `end`; a process group is its control group."""

    def __init__(self, unit: Path, socket_path: Path) -> None:
        super().__init__(name="supervisor", daemon=True)
        self.unit = read_unit(unit.read_text())
        self.link = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.link.bind(str(socket_path))
        self.link.settimeout(TURN_S)
        self.main: subprocess.Popen[bytes]
        self.sent: list[str] = []
        """What the service has sent."""
        self.ending = False

    def launch(self) -> None:
        told = {"NOTIFY_SOCKET": self.link.getsockname()}
        words = [word.strip('"') for word in self.unit["ExecStart"].split()]
        quiet = {"stdout": subprocess.DEVNULL, "start_new_session": True}
        self.main = subprocess.Popen(words, env=os.environ | told, **quiet)

    def runs(self) -> bool:
        """Whether a process of the service has not ended."""
        for stat in Path("/proc").glob("[0-9]*/stat"):
            with suppress(OSError):
                state, _, group, *_ = stat.read_text().rpartition(") ")[2].split()
                if int(group) == self.main.pid and state != "Z":
                    return True
        return False

    def stop(self) -> None:
        """End all that runs, as the only kill mode that the unit may have says."""
        assert self.unit["KillMode"] == "control-group"
        end_s = time.monotonic() + float(self.unit["TimeoutStopSec"])
        for number in (signal.Signals[self.unit["KillSignal"]], signal.SIGKILL):
            with suppress(ProcessLookupError):
                os.killpg(self.main.pid, number)
            while self.runs() and time.monotonic() < end_s:
                self.turn()
        self.main.wait()

    def turn(self) -> None:
        """Take what the service sends."""
        with suppress(TimeoutError):
            self.sent += self.link.recv(4096).decode().splitlines()

    def run(self) -> None:
        while not self.ending:
            self.launch()
            while not self.ending and self.main.poll() is None:
                self.turn()
            self.stop()
            end_s = time.monotonic() + float(self.unit["RestartSec"])
            while not self.ending and time.monotonic() < end_s:
                self.turn()
        self.link.close()

    def end(self, timeout_s: float) -> int:
        """Stop the service as `systemctl stop` does; return its exit code."""
        self.ending = True
        self.join(timeout_s)
        assert not self.is_alive()
        return self.main.returncode
