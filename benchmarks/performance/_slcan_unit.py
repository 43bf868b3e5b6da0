"""A control unit on a serial CAN adapter that answers every SYNC at once: python -m ...

A process of its own with a pseudo-terminal. It knows nothing but made frames, encoded beforehand,
so that it is never what is measured. It prints the terminal's path when it is ready; each line
``{"counter": N, "frames": M}`` on its standard input says with which counter it goes on, and how
many frames it makes, which it then repeats. It ends with its input.
"""

import json
import os
import select
import sys
import time
import tty

from benchmarks.performance._frame_feed import FRAME_ID, NODE_ID, bursts, made_counts

_HEARTBEAT = b"t%03X105\r" % (0x700 + NODE_ID)
_HEARTBEAT_S = 0.1
_SYNC = b"t0800"


def encoded(first_counter: int, n_frames: int) -> list[bytes]:
    """Return what the adapter sends for each frame: its messages as lines of the slcan protocol."""
    head = b"t%03X8" % FRAME_ID
    return [
        b"".join(head + data.hex().upper().encode() + b"\r" for data in burst)
        for burst in bursts(made_counts(n_frames), first_counter)
    ]


def _write(descriptor: int, data: bytes) -> None:
    """Send what the terminal takes; the rest is lost, as in an adapter whose memory is full."""
    try:
        os.write(descriptor, data)
    except BlockingIOError:
        return


def main() -> None:
    master, slave = os.openpty()
    tty.setraw(slave)
    os.set_blocking(master, False)
    print(json.dumps({"port": os.ttyname(slave)}), flush=True)
    frames: list[bytes] = []
    sent, rest, beat_s = 0, b"", 0.0
    while True:
        readable, _, _ = select.select([master, sys.stdin], [], [], _HEARTBEAT_S)
        if sys.stdin in readable:
            text = sys.stdin.readline()
            if not text:
                return
            wish = json.loads(text)
            frames, sent = encoded(wish["counter"], wish["frames"]), 0
            print("{}", flush=True)
        if time.monotonic() >= beat_s and frames:
            beat_s = max(beat_s, time.monotonic() - _HEARTBEAT_S) + _HEARTBEAT_S
            _write(master, _HEARTBEAT)
        if master in readable:
            *lines, rest = (rest + os.read(master, 4096)).split(b"\r")
            for line in lines:
                if line == _SYNC and frames:
                    _write(master, frames[sent % len(frames)])
                    sent += 1


if __name__ == "__main__":
    main()
