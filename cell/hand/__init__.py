"""The hand: gripper and tactile sensor as one interface, in this process or in its own.

For the controller: `interface.Hand`; `build` makes the one that the config asks for. `local` runs
in the caller's thread; `client`, `server` and `messages` are the two ends of a process with real-
time priority and what crosses between them.
"""
