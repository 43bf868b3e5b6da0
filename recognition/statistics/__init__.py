"""Statistics of recognisers: discriminants, calibration, novelty, fusion, the next grasp."""
