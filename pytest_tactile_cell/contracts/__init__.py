"""Contracts of plugins as tests, one file for each kind: `pytest --contract sensor`."""
