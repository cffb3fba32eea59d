"""Judges whether a pose may be trusted, by what it is made from, and names the states of it."""
