"""The simulated world between the fingers, for the cell and for virtual grasps.

`world` presses rigid objects (`shapes`) into foam pads and scans their taxels (`pads`); `stage`
moves them with the axes.
"""
