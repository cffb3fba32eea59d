"""Keeps account of a bag's topics, counts and times, and writes rosbag2's ``metadata.yaml``."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from anser_ros.wire.yaml_text import DUMPER, read_yaml

METADATA_VERSION = 9
"""Version of rosbag2's metadata.yaml that is written, as ROS 2 Jazzy reads it."""
# What rosbag2 calls "for ever".
FOREVER = {'sec': 9223372036, 'nsec': 854775807}


def qos_profile(*, reliable: bool = True, latched: bool = False, depth: int = 1) -> dict[str, Any]:
    """Return an offered quality of service as rosbag2 (version 9) writes it."""
    return {
        'history': 'keep_last',
        'depth': depth,
        'reliability': 'reliable' if reliable else 'best_effort',
        'durability': 'transient_local' if latched else 'volatile',
        'deadline': FOREVER,
        'lifespan': FOREVER,
        'liveliness': 'automatic',
        'liveliness_lease_duration': FOREVER,
        'avoid_ros_namespace_conventions': False,
    }


@dataclass
class TopicRecord:
    """Records a topic of a bag and how much of it was written."""

    name: str
    type_name: str
    type_hash: str
    qos: Sequence[Mapping[str, Any]]
    messages: int = 0


@dataclass
class BagRecord:
    """Records what a bag holds so far; times are log times in ns."""

    topics: dict[int, TopicRecord] = field(default_factory=dict)
    messages: int = 0
    first_ns: int = 0
    last_ns: int = 0

    @property
    def duration_s(self) -> float:
        """Return the time between the first and the last message, s."""
        return (self.last_ns - self.first_ns) * 1e-9


def write_metadata(path: Path, record: BagRecord, ros_distro: str, is_closed: bool = True) -> None:
    """Write ``metadata.yaml`` of the folder that holds one MCAP file, in place of an older one.

    The bag may still be written: then it is not ``is_closed``.
    """
    times = {
        'duration': {'nanoseconds': record.last_ns - record.first_ns},
        'starting_time': {'nanoseconds_since_epoch': record.first_ns},
        'message_count': record.messages,
    }
    document = {
        'rosbag2_bagfile_information': {
            'version': METADATA_VERSION,
            'storage_identifier': 'mcap',
            **times,
            'topics_with_message_count': [_topic(topic) for topic in record.topics.values()],
            'compression_format': '',
            'compression_mode': '',
            'relative_file_paths': [path.name],
            'files': [{'path': path.name, **times}],
            'custom_data': {'closed': 'true' if is_closed else 'false'},
            'ros_distro': ros_distro,
        }
    }
    target = path.with_name('metadata.yaml')
    draft = path.with_name('.metadata.yaml.new')
    try:
        draft.write_text(plain_yaml(document), encoding='utf-8')
        draft.replace(target)
    finally:
        draft.unlink(missing_ok=True)


def bag_summary(folder: Path) -> dict[str, Any]:
    """Return ``duration_s``, ``messages`` and ``closed`` of a bag's ``metadata.yaml``; {} if none.

    A bag that was not closed may hold more than that; its readers do not use this file.
    """
    try:
        document = read_yaml((folder / 'metadata.yaml').read_text('utf-8'))
        info = document['rosbag2_bagfile_information']
        return {
            'duration_s': 1e-9 * float(info['duration']['nanoseconds']),
            'messages': int(info['message_count']),
            'closed': info['custom_data']['closed'] == 'true',
        }
    except (OSError, yaml.YAMLError, LookupError, TypeError, ValueError):
        return {}


def plain_yaml(document: Any) -> str:
    """Return a document as YAML without anchors, which not every reader follows."""
    return yaml.dump(document, Dumper=_Dumper, sort_keys=False)


class _Dumper(DUMPER):  # type: ignore[misc]
    def ignore_aliases(self, data: Any) -> bool:
        return True


def _topic(topic: TopicRecord) -> dict[str, Any]:
    return {
        'topic_metadata': {
            'name': topic.name,
            'type': topic.type_name,
            'serialization_format': 'cdr',
            'offered_qos_profiles': [dict(profile) for profile in topic.qos],
            'type_description_hash': topic.type_hash,
        },
        'message_count': topic.messages,
    }
