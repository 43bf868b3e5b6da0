"""Questions to the person at the terminal."""

import os
import sys

import typer


def ask(text: str) -> str:
    """Ask and return the line that is typed; EOFError at the end of input.

    From a pipe it is read past Python's buffer: a program that ends while somebody still waits in
    the buffer is ended by an abort.
    """
    stdin = sys.__stdin__
    if stdin is None or sys.stdin is not stdin or stdin.isatty():
        return input(text)
    typer.echo(text, nl=False)
    line = bytearray()
    while not line.endswith(b"\n"):
        read = os.read(stdin.fileno(), 1)
        if not read:
            raise EOFError
        line += read
    return line.decode(errors="replace").rstrip("\r\n")
