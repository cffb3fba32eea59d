"""Package dashboard."""
