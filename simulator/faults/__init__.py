"""Faults of the simulated cell by name, for tests, the command line and the config.

`simulator.faults.injector` has the vocabulary and injects and clears its faults; `text` is the form
in which they are written; `entry` is what one of them is. The words stand by component: `can` (CAN
link, control unit, taxels), `servos` (servo bus, single servos), `axes` (drives
and servos that carry the part) and `object` (the part).
"""
