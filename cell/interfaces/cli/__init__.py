"""The command line: arguments and printing, no logic.

`app` lists the commands and turns errors into exit codes. Each command has its own file in
`commands`. `options` holds shared options, `session` runs the cell, `signals` handles Ctrl-C,
`terminal` prints.
"""

import signal
import sys
from types import FrameType

from cell.installation import refuse_shadows

__all__ = ["main"]


def main() -> None:
    """Run the command line and end the program with its exit code.

    Ctrl-C always ends the program with exit code 1, also when it is pressed repeatedly. Without
    this, Python would end by the signal, or with an error of the module that was being loaded.
    """
    try:
        refuse_shadows()
    except ImportError as error:
        sys.exit(f"error: {error}")
    interrupted = False

    def on_ctrl_c(_number: int, _frame: FrameType | None) -> None:
        nonlocal interrupted
        interrupted = True
        raise KeyboardInterrupt

    text = "interrupted before the command started"
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
    """Ignore signals: they must not change the exit code while the interpreter ends."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
