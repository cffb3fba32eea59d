"""Holds the effects of trackers of poses, one file each."""
