"""Holds the parts of the field_model node: the refit in force, its start, its two topics."""
