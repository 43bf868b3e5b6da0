"""A client written by others talks to the simulated servos over a real pseudo-terminal.

It is rustypot; `test_manual_dialogue` has another encoder of packets. The driver is a third client:
its packets are those of the vendor's package.
"""

import select
import threading
import time
from pathlib import Path

import rustypot

from simulator.realtime.terminals import SerialPty
from tests.simulator.conftest import ServoBench

TIMEOUT_S = 10.0
"""Patience in s with an answer: other tests run beside this one."""
LOOKS_LIKE_A_HEADER = bytes.fromhex("FFFFFDFF")


def test_a_ping_and_sync_reads_of_bytes_like_a_header(tmp_path: Path) -> None:
    bench, ended = ServoBench(settings={"operating_mode": 5}), threading.Event()
    endpoint = SerialPty(bench.device, tmp_path / "servos")

    def serve() -> None:
        while not ended.is_set():
            select.select([endpoint], [], [], 0.001)
            endpoint.poll(time.monotonic())

    thread = threading.Thread(target=serve)
    thread.start()
    client = rustypot.Xl430PyController(endpoint.path, 1_000_000, TIMEOUT_S)
    try:
        assert client.ping(1)
        blocks = client.sync_read_raw_data([1, 2], 126, 10)
        positions = [int.from_bytes(bytes(block)[6:], "little") for block in blocks]
        assert positions == [servo.present_raw() for servo in bench.servos]
        assert client.write_raw_data_with_error(1, 116, list(LOOKS_LIKE_A_HEADER)) == 0
        bench.servos[1].registers.put("goal_position", -131073)
        blocks = client.sync_read_raw_data([1, 2], 116, 4)
        assert [bytes(block) for block in blocks] == [LOOKS_LIKE_A_HEADER] * 2
    finally:
        client.close()
        ended.set()
        thread.join()
        endpoint.close()
