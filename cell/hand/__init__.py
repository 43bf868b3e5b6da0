"""The hand: gripper and tactile sensor as one interface, in this process or in its own.

For the controller: `interface.Hand`; `build` makes the hand of a config. `local` runs in the
caller's thread. `client`, `server` and `messages` are for a process with real-time priority.
"""
