"""The command line: arguments and printing, no logic."""

import os

# Matrices here are small: a second BLAS thread gains nothing alone and spins against the force loop
# and every other process when the machine is busy. It must be said before numpy is loaded.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from cell.cli.app import main

__all__ = ["main"]
