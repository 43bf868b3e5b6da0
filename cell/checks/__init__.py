"""Checks of a cell for the system check and the commissioning; no check moves the cell.

`findings`: results of steps and checks. `ports`: rights and speed of serial ports.
"""
