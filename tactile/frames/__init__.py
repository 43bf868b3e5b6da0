"""Tactile frames, for the link and for the simulated control unit.

`codec` turns samples into messages; `assembler` turns messages into whole frames; `flow` watches
that they keep coming; `pad_features` are the totals and centroids that the unit computes.
"""
