"""Tactile frames, for the link and for the simulated control unit.

`codec` converts samples to messages, and `assembler` messages to complete frames. `force_message`
is for the force messages and their order.
"""
