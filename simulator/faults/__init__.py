"""Faults of the simulated cell by name, for tests, the command line and the config.

`simulator.faults.injector` has the vocabulary, parses the texts of faults, injects and clears them;
`entry` defines one fault. Each component has a file: `can` (CAN link, control unit, taxels),
`boards`, `servos` (servo bus, single servos), `axes` (drives and servos that carry the part) and
`object` (the part).
"""
