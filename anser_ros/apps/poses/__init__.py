"""Package poses."""
