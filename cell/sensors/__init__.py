"""The built-in sensors, and the guard of sensors from other packages."""
