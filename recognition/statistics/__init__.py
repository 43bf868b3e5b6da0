"""Statistics of recognisers: discriminants, calibration, novelty, fusion."""
