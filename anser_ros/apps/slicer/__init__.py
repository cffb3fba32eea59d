"""Package slicer."""
