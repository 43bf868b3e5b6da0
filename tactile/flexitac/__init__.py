"""FlexiTac: a resistive matrix on each finger, whose board sends its frames over USB serial.

`source` is the frame source of two boards; `stream` finds the frames in the bytes of one board.
"""
