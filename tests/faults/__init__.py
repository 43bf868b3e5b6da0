"""The fault campaign: each variant of each kind of fault on the simulated cell, and random ones.

``table`` has the rows as data, ``campaign`` the cell that they run on and the faults that need
code, ``invariants`` what may never happen, ``test_state_machine`` the random commands and faults.
`make campaign` runs all of it.
"""
