"""Sets the quality of service of every topic: one profile a kind of topic, alike on both ends."""

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy


def latched(depth: int) -> QoSProfile:
    """Return the profile of what a late joiner must still get."""
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=DurabilityPolicy.TRANSIENT_LOCAL,
    )


# The setup document and whatever else holds until it is said again.
LATCHED = latched(1)
# Field models and their uncertainty. While the model is refitted every frame has its own, so what
# a busy reader has not taken yet must not give way to the next: there is room for a second's.
MODELS = latched(50)
# Their uncertainty is a larger message; there is room for a third of a second.
MODEL_ERRORS = latched(16)
# Fluxes and poses. Reliable, and deep enough to bridge half a second at 200 Hz without a loss.
STREAM = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=100,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.VOLATILE,
)
# /diagnostics and /tf, as everybody else has them.
EVENTS = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=100,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.VOLATILE,
)
