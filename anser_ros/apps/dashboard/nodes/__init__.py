"""Package nodes."""
