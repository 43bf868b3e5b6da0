"""Learning: models and their files, training, drift, shape and size, grasps from drawings.

For jobs and interfaces: `taught_model.TaughtModel` (what a running cell is taught, and its drift),
`training`, `model` (model files), `training_set` (the data set beside one), `taught_shapes`,
`teaching_summary`, `shape_reading` (shape and size), `pad_knowledge` (foam and sensor),
`virtual_grasps` (from a drawing), `blas` (threads of the linear algebra). None drives a cell.
"""
