"""The paper's complete method: quadric surfaces, eigenvalues, sweeps of poses, the level check.

`level` finds the pressed patch of a grasp and computes its value. `quadric` fits a surface to the
patch, computes its smallest eigenvalue, and has Algorithm 1: the sweep over a grid of poses, and
the bands of its values. `proofs` has the paper's equations in numbers. Names follow the paper: Q,
M, D, lambda.
"""
