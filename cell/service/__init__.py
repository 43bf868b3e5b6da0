"""The service: what many clients of one cell need: lease, stops, pose handshake, shift, history.

`service.open_service` opens it. Interfaces command through `Service`, and ask its `plugin`.
"""
