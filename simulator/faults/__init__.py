"""Faults of the simulated cell by name, for tests, the command line and the config.

`vocabulary` defines and has all faults; `injector` reads their texts, injects and clears.
"""
