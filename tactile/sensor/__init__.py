"""The tactile sensor, for the cell: readings in newtons from whole frames.

`sensor` is the entry. `tare` measures the zero, `calibration` converts counts to newtons,
`filters` smooth and find touched taxels, `quality` finds taxels that do not measure, `force_check`
compares the unit's force with that of the frames. `grip_force` has the samples for a force loop,
`opening` opens a sensor in one call, `settings` has the limits.
"""
