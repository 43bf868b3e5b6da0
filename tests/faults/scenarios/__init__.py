"""Faults that need code of their own: each function gets its row and returns what was observed."""
