"""States what this application adds to the core; `anser_ros.extensions` describes the tables."""

OFFLINE = {
    'place': 'propose places of reference coils, with the error that each number of them leaves',
    'plan': 'which accuracy which effort of calibration buys, for a board and a tool',
}
