"""The service: one resident cell for many clients, with lease, jobs, photos and pose handshake.

`opening` opens it. The interfaces in `cell.interfaces` are thin adapters on `service.Service`.
"""
