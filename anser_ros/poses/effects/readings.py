"""Names what is found in a session's numbers and names before anything is searched for."""

from anser_ros.poses.effect import PoseEffect, Role


class FrameConvention(PoseEffect):
    """States how a stream's numbers are meant, as `anser_ros.poses.convention` finds out."""

    name = 'frame_convention'
    summary = 'the poses follow another convention than the stream states'
    role = Role.READING


class SwappedSensors(PoseEffect):
    """States whose poses are whose, as `anser_ros.poses.swaps` finds out."""

    name = 'swapped_sensors'
    summary = 'two sensors are exchanged'
    role = Role.SWAP


EFFECTS = (FrameConvention(), SwappedSensors())
