"""A supervisor that runs a unit file as systemd does: readiness, watchdog, kill mode, restart.

    python -m tests.hil.supervisor UNIT

Each line on standard output is a JSON object: what happened, and to which process. SIGTERM stops
the service as `systemctl stop` does, and ends the supervisor. Orphans of the service become its
children, as those of a control group stay in it.
"""

import ctypes
import json
import os
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from contextlib import suppress
from pathlib import Path

PR_SET_CHILD_SUBREAPER = 36
TURN_S = 0.02


def read_unit(text: str) -> dict[str, str]:
    """Return the last value of each key."""
    lines = (line.partition("=") for line in text.splitlines())
    return {key: value for key, equals, value in lines if equals and key.isalpha()}


def say(event: str, **values: object) -> None:
    sys.stdout.write(json.dumps({"event": event, **values}) + "\n")
    sys.stdout.flush()


class Supervisor:
    def __init__(self, unit: dict[str, str], link: socket.socket) -> None:
        self.unit, self.link = unit, link
        self.main: subprocess.Popen[bytes] | None = None
        self.fed_s = self.ready_s = float("inf")
        self.ending = False

    def start(self) -> None:
        limit_us = 1_000_000 * int(self.unit["WatchdogSec"])
        told = {"NOTIFY_SOCKET": self.link.getsockname(), "WATCHDOG_USEC": str(limit_us)}
        self.fed_s = float("inf")
        words = [word.strip('"') for word in self.unit["ExecStart"].split()]
        self.main = subprocess.Popen(words, stdout=subprocess.DEVNULL, env=os.environ | told)
        say("started", pid=self.main.pid)

    def group(self) -> list[int]:
        """Return all processes below this one, those without a parent of their own too."""
        children = defaultdict(list)
        for stat in Path("/proc").glob("[0-9]*/stat"):
            with suppress(OSError):
                pid, _, rest = stat.read_text().partition(" (")
                state, parent = rest.rpartition(") ")[2].split()[:2]
                if state != "Z":
                    children[int(parent)].append(int(pid))
        found, look = [], [os.getpid()]
        while look:
            look = [child for parent in look for child in children[parent]]
            found += look
        return found

    def kill(self, number: signal.Signals) -> None:
        """Send a signal to every process."""
        for pid in self.group():
            with suppress(ProcessLookupError):
                os.kill(pid, number)

    def stop(self, first: signal.Signals) -> None:
        """End all that runs, as the only kill mode that the unit may have says."""
        assert self.unit["KillMode"] == "control-group"
        assert self.main is not None
        self.kill(first)
        end_s = time.monotonic() + float(self.unit["TimeoutStopSec"])
        while self.group():
            if time.monotonic() > end_s:
                say("timeout")
                self.kill(signal.SIGKILL)
                break
            self.turn()
        self.main.wait()

    def turn(self) -> None:
        """Take what the service sends, and what has ended."""
        with suppress(TimeoutError):
            data, credentials, _, _ = self.link.recvmsg(4096, socket.CMSG_SPACE(12))
            (_, _, raw) = credentials[0]
            pid = struct.unpack("3i", raw)[0]
            if self.main is None or pid != self.main.pid:
                return say("ignored", pid=pid, text=data.decode())
            for line in data.decode().splitlines():
                if line == "WATCHDOG=1":
                    self.fed_s = time.monotonic()
                else:
                    if line == "READY=1":
                        self.fed_s = time.monotonic()
                    say("sent", pid=pid, text=line)
        for pid in {int(p) for p in _children()} - {self.main.pid if self.main else 0}:
            with suppress(ChildProcessError):
                os.waitpid(pid, os.WNOHANG)

    def run(self) -> None:
        while not self.ending:
            self.start()
            assert self.main is not None
            first = signal.Signals[self.unit["KillSignal"]]
            while not self.ending and self.main.poll() is None:
                self.turn()
                if time.monotonic() - self.fed_s > float(self.unit["WatchdogSec"]):
                    say("watchdog")
                    first = signal.Signals[self.unit["WatchdogSignal"]]
                    break
            self.stop(first)
            say("ended", code=self.main.returncode)
            end_s = time.monotonic() + float(self.unit["RestartSec"])
            while not self.ending and time.monotonic() < end_s:
                self.turn()

    def end(self, *_: object) -> None:
        self.ending = True


def _children() -> list[str]:
    return Path(f"/proc/self/task/{os.getpid()}/children").read_text().split()


def main(unit: str) -> None:
    ctypes.CDLL(None).prctl(PR_SET_CHILD_SUBREAPER, 1)
    with (
        tempfile.TemporaryDirectory() as folder,
        socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as link,
    ):
        link.bind(f"{folder}/notify")
        link.setsockopt(socket.SOL_SOCKET, socket.SO_PASSCRED, 1)
        link.settimeout(TURN_S)
        supervisor = Supervisor(read_unit(Path(unit).read_text()), link)
        signal.signal(signal.SIGTERM, supervisor.end)
        supervisor.run()


if __name__ == "__main__":
    main(sys.argv[1])
