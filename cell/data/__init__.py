"""Files of grasps: data sets (.npz) and recordings (MCAP), written whole, read with checks.

For jobs: `dataset` and `recorder` to write, `recording_reader` to read and recover;
`recording_schema` is the format of recordings, `files` has common functions (atomic writing,
bounded reading of archives).
"""
