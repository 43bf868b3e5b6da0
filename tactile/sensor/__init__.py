"""The tactile sensor, for the cell: readings in newtons from whole frames.

`sensor` is where to start; `tare` takes the zero, `calibration` turns counts into newtons,
`filters` smooth and find touched taxels, `quality` finds taxels that do not measure.
"""
