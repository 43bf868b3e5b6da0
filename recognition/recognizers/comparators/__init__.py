"""Methods that the paper names, and plain present ones, for comparison on request."""
