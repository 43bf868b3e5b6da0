"""Tactile frames, for the link and for the simulated control unit.

`codec` converts samples to messages, and `assembler` messages to complete frames. `force_message`
and `force_stream` are for the force messages.
"""
