"""Sets the quality of service of every topic: one profile a kind of topic, alike on both ends."""

from typing import Any

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSPolicyKind, QoSProfile, ReliabilityPolicy

from anser_ros.errors import ParameterError


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
POLICIES: dict[str, Any] = {
    'history': HistoryPolicy, 'depth': int, 'reliability': ReliabilityPolicy,
    'durability': DurabilityPolicy,
}  # fmt: skip
"""What parameters ``qos_overrides`` may change."""
OVERRIDABLE = [QoSPolicyKind[name.upper()] for name in POLICIES]


def check_override(name: str, value: Any) -> None:
    """Raise `ParameterError` where a parameter ``qos_overrides...`` overrides nothing."""
    topic, end, policy = (*name.split('.', 1)[-1].rsplit('.', 2), '', '')[:3]
    if not topic.startswith('/') or end not in ('publisher', 'subscription'):
        raise ParameterError(f'parameter {name}: a full name, publisher or subscription, policy')
    if policy not in POLICIES:
        raise ParameterError(f'parameter {name}: no policy; there are: {", ".join(POLICIES)}')
    kind = POLICIES[policy]
    if kind is int:
        if not isinstance(value, int) or isinstance(value, bool) or value < 1:
            raise ParameterError(f'parameter {name}: {value!r} is no depth')
    elif str(value).upper() not in kind.__members__:
        known = ', '.join(known.lower() for known in kind.__members__)
        raise ParameterError(f'parameter {name}: {value!r} is none of {known}')
