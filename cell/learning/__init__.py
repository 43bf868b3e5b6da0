"""Learning: models and their files, training, drift, shape and size, grasps from drawings.

For jobs and interfaces: `taught_model.TaughtModel` is the model of a running cell, with its
training set and its drift. `training` and `teaching_summary` make it and judge it; `model` has its
files. `shape_reading` has shape and size, `drawing` virtual grasps of a drawing, `parallel` the
work on all cores. They do not drive a cell.
"""
