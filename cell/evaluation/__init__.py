"""Recognizers on recorded grasps, of files or an archive: evaluated, and their spread learnt.

`selected_grasps` reads the grasps, and leaves days, cells or series out in turn.
"""
