"""Names topics of poses, and makes the setup document of a session that has nothing else."""

from collections.abc import Iterable

from anser_ros.wire.setup import topic_of

TRACKED, OPTICAL = '/tracked/', '/optical/'
"""What the topics of tracked and of optical poses begin with."""
ENDING = '/pose'
"""What the topics of poses end with."""
BODY = 'body'
"""What a body is called without a name."""
SCHEMA = 'anser_poses/1'
"""Schema of the setup document of a session of poses."""


def tracked_topic(sensor: str) -> str:
    """Return the topic of a sensor of a tracker that gives poses."""
    return f'{TRACKED}{topic_of(sensor)}{ENDING}'


def optical_topic(body: str, namespace: str = OPTICAL) -> str:
    """Return the topic of a body's optical poses; a second board has another namespace."""
    return f'{namespace.rstrip("/")}/{topic_of(body)}{ENDING}'


def optical_stem(topic: str) -> str:
    """Return the stem of the body whose optical poses a topic has, in whatever namespace.

    It is empty for a topic of anything else.
    """
    return topic.partition(OPTICAL)[2].removesuffix(ENDING)


def pose_setup(sensors: Iterable[str], body: str) -> str:
    """Return the setup document of a session of poses, as text."""
    return f'schema: {SCHEMA}\nsensors: [{", ".join(sensors)}]\nbody: {body}\n'
