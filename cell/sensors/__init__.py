"""The sensors that are built in, and the guard of those that other packages bring."""
