"""Bags of which only the beginning is wanted; for benchmarks too, so nothing here sets up ROS."""

from pathlib import Path

from anser_ros.wire.bag import Salvage, iter_messages
from anser_ros.wire.bag_writer import BagWriter


def beginning(bag: Path, out: Path, length_s: float) -> Path:
    """Copy the first seconds of a bag, message by message."""
    writer, channels, end_ns = BagWriter(out), {}, None
    for message in iter_messages(bag, Salvage()):
        end_ns = end_ns or message.log_time_ns + round(1e9 * length_s)
        if message.log_time_ns > end_ns:
            break
        if message.topic not in channels:
            definition = message.schema.data.decode()
            channels[message.topic] = writer.add_topic(
                message.topic, message.type_name, definition
            )
        writer.write(channels[message.topic], message.log_time_ns, message.data)
    writer.close()
    return out
