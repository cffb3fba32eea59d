"""Holds the parts of monitor, dashboard and openigtlink: traces, causes, live view, server."""
