"""The simulated world between the fingers, for the cell and for virtual grasps.

`world` presses rigid objects (`shapes`, `shape_files`) into foam pads (`foam`, `press`) and scans
their taxels (`taxels`); `stage` moves them with the axes.
"""
