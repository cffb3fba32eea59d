"""Package effects."""
