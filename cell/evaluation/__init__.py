"""Recognisers on recorded grasps, of files or an archive: evaluated, compared, and their spread.

`selected_grasps` reads the grasps, and leaves days, cells or series out in turn.
"""
