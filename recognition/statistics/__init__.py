"""Statistics of recognizers: discriminants, calibration, novelty, fusion."""
