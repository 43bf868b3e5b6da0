"""Drift of gain and opening: its effect on grasps, a gauge for it, and following it."""
