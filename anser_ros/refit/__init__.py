"""Refits live: the field model follows reference sensors while metal moves."""
