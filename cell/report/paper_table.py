"""Results of the paper, for comparison."""

TABLE_1_LABELS = ("oval", "cylinder", "box", "ball", "dumbbell")
"""Objects of Table 1, in its order (section 4)."""

TABLE_1 = (
    (100, 0, 0, 0, 0),
    (0, 90, 0, 10, 0),
    (0, 0, 100, 0, 0),
    (0, 10, 0, 90, 0),
    (0, 0, 0, 0, 100),
)
"""Table 1 in per cent of ten trials for each object; row: held, column: named.

The paper prints only the errors; the diagonal is the rest of each row's ten trials.
"""

TABLE_1_TRIALS = 10
"""Trials of each object in Table 1."""
