"""States what this application adds to the core; `anser_ros.extensions` describes the tables."""

LIVE_VIEW = 8642
"""TCP port of the page, which no registered service has."""
NODES = {
    'dashboard': 'a live view in the browser, with the loop of record, diagnose and correct',
    'watcher': 'names the effects that the model lacks, live in /diagnostics',
}
NEEDED = {'dashboard': ('nicegui',)}
PASSIVE = ('dashboard', 'watcher')
DEMO = {
    'dashboard': (
        'serve the live view to a browser, too',
        f'live view: http://127.0.0.1:{LIVE_VIEW}/',
    )
}
