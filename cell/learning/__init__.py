"""Learning: models and their files, training, drift, shape and size, grasps from drawings.

For jobs and interfaces: `taught_model.TaughtModel` (teaches, answers, follows a drift, is saved),
`collection` (grasps of a known object), `training`, `model` (model files), `teaching_summary`,
`shape_reading` (shape and size), `pad_knowledge` (foam and sensor), `virtual_grasps` (from a
drawing), `blas` (threads of the linear algebra).
"""
