"""A supervisor that runs a unit file as systemd does: readiness, watchdog, kill mode, restart.

Orphans of the service become children of this process, as those of a control group stay in it.
"""

import ctypes
import os
import signal
import socket
import struct
import subprocess
import threading
import time
from collections import defaultdict
from contextlib import suppress
from pathlib import Path

from tests.hil.program import ended

PR_SET_CHILD_SUBREAPER = 36
TURN_S = 0.02


def read_unit(text: str) -> dict[str, str]:
    """Return the last value of each key."""
    lines = (line.partition("=") for line in text.splitlines())
    return {key: value for key, equals, value in lines if equals and key.isalpha()}


class Supervisor(threading.Thread):
    """Keeps the service of a unit running until `end`; what runs already is not of the service."""

    def __init__(self, unit: Path, socket_path: Path) -> None:
        super().__init__(name="supervisor", daemon=True)
        self.unit = read_unit(unit.read_text())
        self.link = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.link.bind(str(socket_path))
        self.link.setsockopt(socket.SOL_SOCKET, socket.SO_PASSCRED, 1)
        self.link.settimeout(TURN_S)
        self.main: subprocess.Popen[bytes]
        self.sent: list[str] = []
        """What the service has sent, without the food of its watchdog."""
        self.fed_s = float("inf")
        self.ending = False
        self.others = set(self.group())

    def launch(self) -> None:
        limit_us = 1_000_000 * int(self.unit["WatchdogSec"])
        told = {"NOTIFY_SOCKET": self.link.getsockname(), "WATCHDOG_USEC": str(limit_us)}
        self.fed_s = float("inf")
        words = [word.strip('"') for word in self.unit["ExecStart"].split()]
        self.main = subprocess.Popen(words, stdout=subprocess.DEVNULL, env=os.environ | told)

    def group(self) -> list[int]:
        """Return all processes of the service, those without a parent of their own too."""
        children = defaultdict(list)
        for stat in Path("/proc").glob("[0-9]*/stat"):
            with suppress(OSError):
                pid, _, rest = stat.read_text().partition(" (")
                state, parent = rest.rpartition(") ")[2].split()[:2]
                if state != "Z":
                    children[int(parent)].append(int(pid))
        members, look = [], [os.getpid()]
        while look:
            known = getattr(self, "others", ())
            look = [pid for parent in look for pid in children[parent] if pid not in known]
            members += look
        return members

    def kill(self, number: signal.Signals) -> None:
        """Send a signal to every process."""
        for pid in self.group():
            with suppress(ProcessLookupError):
                os.kill(pid, number)

    def stop(self, first: signal.Signals) -> None:
        """End all that runs, as the only kill mode that the unit may have says."""
        assert self.unit["KillMode"] == "control-group"
        self.kill(first)
        end_s = time.monotonic() + float(self.unit["TimeoutStopSec"])
        while self.group():
            if time.monotonic() > end_s:
                self.kill(signal.SIGKILL)
                break
            self.turn()
        self.main.wait()

    def turn(self) -> None:
        """Take what the service sends, and what has ended."""
        with suppress(TimeoutError):
            data, credentials, _, _ = self.link.recvmsg(4096, socket.CMSG_SPACE(12))
            (_, _, raw) = credentials[0]
            if struct.unpack("3i", raw)[0] != self.main.pid:
                return
            for line in data.decode().splitlines():
                if line in ("WATCHDOG=1", "READY=1"):
                    self.fed_s = time.monotonic()
                if line != "WATCHDOG=1":
                    self.sent.append(line)
        for children in Path("/proc/self/task").glob("*/children"):
            for pid in {*map(int, children.read_text().split())} - {self.main.pid, *self.others}:
                if ended(pid):
                    with suppress(ChildProcessError):
                        os.waitpid(pid, os.WNOHANG)

    def run(self) -> None:
        ctypes.CDLL(None).prctl(PR_SET_CHILD_SUBREAPER, 1)
        try:
            while not self.ending:
                self.launch()
                first = signal.Signals[self.unit["KillSignal"]]
                while not self.ending and self.main.poll() is None:
                    self.turn()
                    if time.monotonic() - self.fed_s > float(self.unit["WatchdogSec"]):
                        first = signal.Signals[self.unit["WatchdogSignal"]]
                        break
                self.stop(first)
                end_s = time.monotonic() + float(self.unit["RestartSec"])
                while not self.ending and time.monotonic() < end_s:
                    self.turn()
        finally:
            ctypes.CDLL(None).prctl(PR_SET_CHILD_SUBREAPER, 0)
            self.link.close()

    def end(self, timeout_s: float) -> int:
        """Stop the service as `systemctl stop` does; return its exit code."""
        self.ending = True
        self.join(timeout_s)
        assert not self.is_alive()
        return self.main.returncode
