"""Simulated sensor boards without CANopen, and the physics of their pads."""
