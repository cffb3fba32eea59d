"""Holds the parts of watcher: a finding in words, and the poses of trackers of poses."""
