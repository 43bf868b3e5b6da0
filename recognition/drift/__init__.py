"""Drift of gain and opening since teaching: its effect on grasps, and its estimate from them."""
