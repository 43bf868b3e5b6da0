"""Who asks a cell for something: the command line, a host program."""
