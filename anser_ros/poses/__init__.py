"""Serves trackers that give poses only: sessions, hand-eye, diagnosis, correction."""
