"""What the commands do, without arguments and printing; one job a file."""
