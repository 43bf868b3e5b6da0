"""Recorded grasps: data sets (.npz) and recordings (MCAP), written whole, read with checks.

`dataset` and `recorder` write; `reader` reads and recovers recordings, whose format is in `schema`.
`sink` is the file of a recording, `retention` deletes the oldest.
"""
