"""Tactile frames, for the link and for the simulated control unit.

`transport` converts messages to complete frames. `force_message` is for the force messages and
their order.
"""
