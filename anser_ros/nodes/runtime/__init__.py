"""Holds what every node runs in: its life, its process, parameters, diagnostics and handover."""
