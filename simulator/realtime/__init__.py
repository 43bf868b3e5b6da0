"""The simulated cell as a process in real time, for clients in other processes.

`process` runs the cell and carries out requests of clients at its Unix socket; `terminals` are its
buses as pseudo-terminals; `hands` are commands for persons.
"""
