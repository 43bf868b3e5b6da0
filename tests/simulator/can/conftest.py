"""A device that stands for any on the simulated bus."""

import math

from simulator.can.node import SendBurst


class Echo:
    """Keeps what it hears, and sends what the test gives to `send`."""

    def __init__(self) -> None:
        self.heard: list[tuple[float, int, bytes]] = []
        self.due_s = math.inf
        """When it sends a heartbeat by itself."""

    def connect(self, send: SendBurst) -> None:
        self.send = send

    def receive(self, can_id: int, data: bytes, now_s: float) -> None:
        self.heard.append((now_s, can_id, data))

    def advance(self, now_s: float) -> None:
        if now_s >= self.due_s:
            due_s, self.due_s = self.due_s, math.inf
            self.send(due_s, 0x705, [b"\x05"])

    def next_event_s(self) -> float:
        return self.due_s
