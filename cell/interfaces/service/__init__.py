"""One resident cell behind many doors: commands under a lease, jobs, the pose handshake.

For the doors: `service.Service`, and what they share in `doors`. `serving` opens all of them.
"""
