"""The tactile sensor, for the cell: readings in newtons from whole frames.

`sensor` is the entry. `tare` measures the zero, `calibration` converts counts to newtons,
`filters` smooth and find touched taxels, `quality` finds taxels that do not measure.
"""
