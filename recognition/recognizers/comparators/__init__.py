"""Methods that the paper names and plain choices of today, to compare with on request."""
