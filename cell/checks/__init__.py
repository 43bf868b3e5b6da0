"""Checks of a cell for the system check and the commissioning; no check moves the cell.

`findings`: results of steps and checks. `changes`: differences from the commissioning. `ports`:
rights and speed of serial ports.
"""
