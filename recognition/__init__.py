"""From the record of a grasp to what was held: numbers in, numbers out.

A `recognition.grasp.Grasp` goes in, a `recognition.recognizer.Posterior` comes out; trainers are
found by name in `recognition.recognizers`. Grasps are fused in `recognition.fusion`, figures
are made in `recognition.evaluation`. The paper's method: `quadric`, `transform`, `eigen`,
`trajectory`, `level`. Shape and size: `shape_answer`. No file, clock, thread or bus is reached.
"""
