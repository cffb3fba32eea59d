"""Holds the one order of a frame, for live nodes and recordings: read, judge, refit, track."""
