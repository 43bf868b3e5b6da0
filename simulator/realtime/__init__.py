"""The simulated cell as a process in real time, for clients in other processes.

`process` runs the cell; `terminals` are its buses as pseudo-terminals; `requests` carries out
requests of clients at its Unix socket; `hands` are commands for persons.
"""
