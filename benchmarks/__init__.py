"""Each figure that README or docs quote, as a command: python -m benchmarks."""

import os

# One BLAS thread, as the command line has it: the matrices are small, and more threads only spin.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
