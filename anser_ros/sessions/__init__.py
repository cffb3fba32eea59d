"""Reads, prepares, tracks, evaluates and diagnoses recorded sessions; watches those that run."""
