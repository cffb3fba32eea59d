"""How good a tracker is, by the protocols that the field publishes, and where a tool's tip is."""
