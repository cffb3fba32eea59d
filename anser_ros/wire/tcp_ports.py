"""Lists the TCP ports on which this package serves unless a parameter says another."""

LIVE_VIEW = 8642
"""The page of `dashboard`; no registered service has it."""
OPENIGTLINK = 18944
"""That of the OpenIGTLink protocol, which 3D Slicer proposes."""
