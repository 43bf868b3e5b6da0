"""A simulated cell that answers with the real bytes of the real buses.

Servos are Protocol 2.0 devices, the tactile control unit is a CANopen device, and both live in
one world in which rigid objects are pressed into foam pads. The package imports what describes
the hardware (registers, taxel layout, frame format, object dictionary) and never a driver. Where
to start: `simulator.cell` for the cell in virtual time, `simulator.realtime.process` for real time.
"""
