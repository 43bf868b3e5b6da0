"""Properties over bad input, for every parser; `harness` says how many inputs each meets."""
