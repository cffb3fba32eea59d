"""Holds the parts of the field_model node: the active refit, its start, its two topics."""
