"""Sets the quality of service of every topic: one profile a kind of topic, alike on both ends."""

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy


def reliable(depth: int, durability: DurabilityPolicy = DurabilityPolicy.VOLATILE) -> QoSProfile:
    """Return the profile of a topic of which so many messages are kept."""
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=durability,
    )


LATE = DurabilityPolicy.TRANSIENT_LOCAL
"""Of what a late joiner must still get."""
# The setup document and whatever else holds until it is said again.
LATCHED = reliable(1, LATE)
# Field models: while the model is refitted every frame has its own, and what a busy reader has not
# taken yet must not give way to the next, so there is room for a second's.
MODELS = reliable(50, LATE)
# Their uncertainty is a larger message; there is room for a third of a second.
MODEL_ERRORS = reliable(16, LATE)
# Fluxes and poses: deep enough to bridge half a second at 200 Hz without a loss.
STREAM = reliable(100)
# /diagnostics and /tf, as everybody else has them.
EVENTS = reliable(100)
