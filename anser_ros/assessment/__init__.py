"""Assesses how good a tracker is by the field's published protocols, and where a tool's tip is."""
