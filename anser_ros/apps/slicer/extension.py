"""States what this application adds to the core; `anser_ros.extensions` describes the tables."""

OPENIGTLINK = 18944
"""TCP port of the protocol, which 3D Slicer proposes."""
NODES = {'openigtlink': 'serves the poses to 3D Slicer as OpenIGTLink'}
PASSIVE = ('openigtlink',)
