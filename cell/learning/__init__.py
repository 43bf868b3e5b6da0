"""Learning: models and their files, training, drift, shape and size, grasps from drawings.

For jobs and interfaces: `taught_model.TaughtModel` (the model of a running cell, its training set
and its drift), `training`, `model` (model files), `teaching_summary`, `shape_reading` (shape and
size), `drawing` (virtual grasps of a drawing), `blas` (threads of the linear algebra). They do not
drive a cell.
"""
