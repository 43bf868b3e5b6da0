"""Checks of a cell that the system check and the commissioning share; nothing here moves.

`findings`: what steps and checks found. `changes`: what differs from the commissioning. `ports`:
rights and speed of serial ports.
"""
