"""Speed of buses, frames, force loop and naming, each as a ratio to a plain alternative."""
