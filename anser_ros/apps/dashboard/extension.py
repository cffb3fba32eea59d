"""States what this application adds to the core; `anser_ros.extensions` describes the tables."""

NODES = {
    'dashboard': 'a live view in the browser, with the loop of record, diagnose and correct',
}
NEEDED = {'dashboard': ('nicegui',)}
PASSIVE = ('dashboard',)
