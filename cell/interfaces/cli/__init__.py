"""The command line: arguments and printing, no logic.

`app` lists the commands and makes exit codes of errors; each command is a file of its own in
`commands`. `options` holds what several of them take, `session` the cell that they run, `signals`
what Ctrl-C does to it, `terminal` what is printed.
"""

import signal
import sys

__all__ = ["main"]


def main() -> None:
    """Run the command line and end the program with its exit code."""
    try:
        # Loading takes a moment: what is pressed meanwhile interrupts no job.
        from cell.interfaces.cli.app import main as run  # noqa: PLC0415
    except KeyboardInterrupt:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        sys.stderr.write("error: interrupted before anything began\n")
        sys.exit(1)
    run()
