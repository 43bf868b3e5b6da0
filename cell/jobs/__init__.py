"""The jobs of the commands, without arguments and printing; one job per file."""
