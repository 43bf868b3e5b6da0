"""The commands, one a file. Each loads what it needs when it is called: help and Tab load none."""
