"""The simulated cell as a process in real time, for clients in other processes.

`process` runs it; `terminals` are its buses as pseudo-terminals; `requests` are carried out for
clients of its Unix socket (`socket_server`).
"""
