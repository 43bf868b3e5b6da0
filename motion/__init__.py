"""Axes that move the object between two grasps: CiA 402 drives and one Dynamixel wrist.

For a program that moves axes: `motion.axes.Axes` with `motion.axes.Axis` for each, in m and rad.
`drive` is one CiA 402 drive on a CAN bus (`bus`), `servo` one Dynamixel servo in extended position
mode; both count in increments. `object_dictionary` names the objects of a drive (``drive.eds``),
`errors` what can go wrong. Nothing here touches the fingers.
"""
