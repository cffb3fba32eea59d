"""Sets the quality of service of every topic: one profile a kind of topic, alike on both ends."""

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSPolicyKind, QoSProfile, ReliabilityPolicy


def _reliable(depth: int, *, is_latched: bool = False) -> QoSProfile:
    """Return a profile by which so many messages are kept, for a late joiner too if latched."""
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=(DurabilityPolicy.TRANSIENT_LOCAL if is_latched else DurabilityPolicy.VOLATILE),
    )


# The setup document and whatever else holds until it is said again.
LATCHED = _reliable(1, is_latched=True)
# Field models: while the model is refitted every frame has its own, and what a busy reader has not
# taken yet must not give way to the next, so there is room for a second's.
MODELS = _reliable(50, is_latched=True)
# Their uncertainty is a larger message; there is room for a third of a second.
MODEL_ERRORS = _reliable(16, is_latched=True)
# Fluxes and poses: deep enough to bridge half a second at 200 Hz without a loss.
STREAM = _reliable(100)
# Poses of others: best effort takes them from every driver, those of sensor data among them.
OTHERS = QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT)
# /diagnostics and /tf, as everybody else has them.
EVENTS = _reliable(100)
OVERRIDABLE = [QoSPolicyKind[name] for name in ('HISTORY', 'DEPTH', 'RELIABILITY', 'DURABILITY')]
"""What parameters ``qos_overrides`` may change."""
