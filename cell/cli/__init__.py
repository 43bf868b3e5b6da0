"""The command line: arguments and printing, no logic."""

import os
import signal
import sys

# Matrices here are small: a second BLAS thread gains nothing alone and spins against the force loop
# and every other process when the machine is busy. It must be said before numpy is loaded.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

__all__ = ["main"]


def main() -> None:
    """Run the command line; the exit code says how it went."""
    try:
        # Loading takes a second: what is pressed meanwhile interrupts no job.
        from cell.cli.app import main as run  # noqa: PLC0415
    except KeyboardInterrupt:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        sys.stderr.write("error: interrupted before anything began\n")
        sys.exit(1)
    run()
