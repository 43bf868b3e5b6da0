"""Learning: models and their files, training, drift, shape and size, grasps from drawings.

For jobs and interfaces: `taught_model.TaughtModel` (the model of a running cell, and its drift),
`training`, `model` (model files), `training_set` (the data set beside one), `teaching_summary`,
`shape_reading` (shape and size), `virtual_grasps` (from a drawing), `blas` (threads of the linear
algebra). They do not drive a cell.
"""
