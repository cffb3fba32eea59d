"""States what this application adds to the core; `anser_ros.extensions` describes the tables."""

LIVE_VIEW = 8642
"""TCP port of the page, which no registered service has."""
NODES = {
    'dashboard': 'a live view in the browser, with the loop of record, diagnose and correct',
    'monitor': 'a live table of sensors, rates and latencies',
    'watcher': 'names the effects that the model lacks, live in /diagnostics',
}
OFFLINE = {'demo': 'watch a simulated tool being tracked: a live table, a bag, a picture'}
NEEDED = {'dashboard': ('nicegui',)}
PASSIVE = ('dashboard', 'monitor', 'watcher')
