"""The command line: arguments and printing, no logic.

`app` lists the commands and turns errors into exit codes. Each command has its own file in
`commands`. `options` holds shared options, `session` runs the cell, `signals` handles Ctrl-C,
`terminal` prints.
"""

import signal
import sys

from cell.installation import refuse_shadows

__all__ = ["main"]


def main() -> None:
    """Run the command line and end the program with its exit code."""
    try:
        refuse_shadows()
    except ImportError as error:
        sys.exit(f"error: {error}")
    try:
        from cell.interfaces.cli.app import main as run  # noqa: PLC0415  takes a moment

        run()
    except KeyboardInterrupt:
        sys.exit("error: interrupted")
    finally:
        # Signals must not change the exit code while the interpreter ends.
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            signal.signal(number, signal.SIG_IGN)
