"""Holds what every node runs in: its life, its process, parameters and diagnostics."""
