"""Faults of the simulated cell by name, for tests, the command line and the config.

`vocabulary` has all faults, `entry` defines one; `injector` reads their texts, injects and clears.
"""
