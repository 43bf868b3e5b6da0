"""Each figure that README or docs quote, as a command: python -m benchmarks."""
