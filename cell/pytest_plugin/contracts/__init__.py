"""Contracts of plugins as tests, one file a kind: `pytest --contract sensor`."""
