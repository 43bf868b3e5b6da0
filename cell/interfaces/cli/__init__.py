"""The command line: arguments and printing, no logic.

`app` lists the commands and makes exit codes of errors; each command is a file of its own in
`commands`. `options` holds what several of them take, `session` the cell that they run, `signals`
what Ctrl-C does to it, `terminal` what is printed.
"""

import signal
import sys
from types import FrameType

__all__ = ["main"]


def main() -> None:
    """Run the command line and end the program with its exit code.

    Ctrl-C ends with exit code 1 wherever it comes, once or again and again: Python itself would
    end by the signal, or with the error of whatever was just being loaded.
    """
    interrupted = False

    def on_ctrl_c(_number: int, _frame: FrameType | None) -> None:
        nonlocal interrupted
        interrupted = True
        raise KeyboardInterrupt

    text = "interrupted before anything began"
    try:
        if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
            signal.signal(signal.SIGINT, on_ctrl_c)
        from cell.interfaces.cli.app import main as run  # noqa: PLC0415  takes a moment
        from cell.interfaces.cli.signals import INTERRUPTED  # noqa: PLC0415

        text = INTERRUPTED
        run()
    except SystemExit:
        raise
    except BaseException:
        _ignore_signals()
        if not interrupted:
            raise
        sys.stderr.write(f"error: {text}\n")
        sys.exit(1)
    finally:
        _ignore_signals()


def _ignore_signals() -> None:
    """Let nothing change the exit code any more: the interpreter takes a moment to end."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
