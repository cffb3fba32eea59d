"""States what this application adds to the core; `anser_ros.extensions` describes the tables."""

NODES = {
    'dashboard': 'a live view in the browser, with the loop of record, diagnose and correct',
}
NEEDED = {'dashboard': ('nicegui',)}
PASSIVE = ('dashboard',)
DEMO = {
    'dashboard': (
        'serve the live view to a browser, too',
        'live view: http://127.0.0.1:8642/',  # as `wire.tcp_ports` has it
    ),
}
