"""Supervision of a gripped part: whether it is there, slips, or contradicts pads and fingers."""
