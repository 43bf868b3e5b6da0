"""Stand between a program and the servos' terminal, and spoil the bytes that pass.

    python servo_relay.py SERVO_PORT SEED

Prints the path of its own terminal; then takes one order a line: ``pass``, ``flip SHARE``,
``drop SHARE``, ``repeat SHARE``, ``delay SECONDS``, ``cut SHARE``, ``hang_up``. Answers of the
servos are spoilt, requests too with ``flip`` and ``drop``; each read of the terminal counts as one.
"""

import heapq
import itertools
import os
import random
import select
import sys
import termios
import time
import tty

SIZE = 4096


class Relay:
    """Both terminals, and what happens to the bytes between them."""

    def __init__(self, port: str, seed: int) -> None:
        self.servos = os.open(port, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        tty.setraw(self.servos)
        speed = termios.tcgetattr(self.servos)
        speed[4] = speed[5] = termios.B1000000
        termios.tcsetattr(self.servos, termios.TCSANOW, speed)
        self.master, self.slave = os.openpty()
        tty.setraw(self.slave)
        os.set_blocking(self.master, False)
        self.random = random.Random(seed)
        self.order, self.value = "pass", 0.0
        self.queue: list[tuple[float, int, bytes]] = []
        self.count = itertools.count()

    def serve(self) -> None:
        self.say(os.ttyname(self.slave))
        while True:
            left_s = None if not self.queue else max(0.0, self.queue[0][0] - time.monotonic())
            ready, _, _ = select.select([self.servos, self.master, sys.stdin], [], [], left_s)
            if sys.stdin in ready and not self.obey(sys.stdin.readline().split()):
                return
            if self.master in ready:
                self.forward(self.spoilt(os.read(self.master, SIZE), requests=True))
            if self.servos in ready:
                data = self.spoilt(os.read(self.servos, SIZE), requests=False)
                late_s = self.value if self.order == "delay" else 0.0
                heapq.heappush(self.queue, (time.monotonic() + late_s, next(self.count), data))
            while self.queue and self.queue[0][0] <= time.monotonic():
                os.write(self.master, heapq.heappop(self.queue)[2])

    def say(self, text: str) -> None:
        sys.stdout.write(text + "\n")
        sys.stdout.flush()

    def forward(self, data: bytes) -> None:
        if data:
            os.write(self.servos, data)

    def obey(self, words: list[str]) -> bool:
        """Take an order; False where there is no more to do."""
        if not words or words[0] == "hang_up":
            return False
        self.order, self.value = words[0], float(words[1]) if len(words) > 1 else 0.0
        self.say("yes")
        return True

    def spoilt(self, data: bytes, *, requests: bool) -> bytes:
        if not data or self.order in {"pass", "delay"} or self.random.random() >= self.value:
            return data
        if self.order == "drop":
            return b""
        if self.order == "flip":
            bit = self.random.randrange(8 * len(data))
            changed = bytearray(data)
            changed[bit // 8] ^= 1 << bit % 8
            return bytes(changed)
        if requests:
            return data
        if self.order == "repeat":
            return data + data
        return data[: self.random.randrange(len(data))]


if __name__ == "__main__":
    Relay(sys.argv[1], int(sys.argv[2])).serve()
