"""Holds the field model, the dipoles that it consists of, and the measurements it explains."""
