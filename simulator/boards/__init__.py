"""Simulated sensor boards that are no CANopen node, with the physics of their pads."""
