"""The paper's complete method: quadric surfaces, eigenvalues, sweeps of poses, the level check.

`contact` finds the pressed patch, `quadric` fits a surface to it, `eigen` computes its smallest
eigenvalue. `trajectory` runs Algorithm 1 over a grid of poses, `thresholds` makes bands of the
values. `level` computes the value of a grasp. Names follow the paper: Q, M, D, lambda.
"""
