"""The command line: arguments and printing, no logic."""

from cell.cli.app import main

__all__ = ["main"]
