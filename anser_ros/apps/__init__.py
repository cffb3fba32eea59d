"""Package apps."""
