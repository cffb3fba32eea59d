"""Holds the offline commands of the console script, with their reports, figures and processes."""
