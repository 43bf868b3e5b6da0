"""The paper's complete method: quadric surfaces, eigenvalues, sweeps of poses, the level check.

`level` finds the pressed patch of a grasp and computes its value. `quadric` fits a surface to the
patch, `eigen` computes the smallest eigenvalue of the surface. `trajectory` runs Algorithm 1 over a
grid of poses, `thresholds` makes bands of the values, and `proofs` has the paper's equations in
numbers. Names follow the paper: Q, M, D, lambda.
"""
