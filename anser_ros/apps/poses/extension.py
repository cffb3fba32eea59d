"""States what this application adds to the core; `anser_ros.extensions` describes the tables."""

NODES = {'corrector': 'corrects the poses of another tracker with a model of diagnose --poses'}
OFFLINE = {
    'accuracy': 'jitter, drift, distances, rotations, latency by published protocols',
    'error_map': 'learn an error map from tracked and true positions, and apply it to others',
    'handeye': 'frames, lever arm, mount and clocks of two streams of poses, jointly',
    'import_poses': 'files of poses as trackers write them, to a bag',
    'pivot': 'the tip of a stylus, from poses while it turns about its tip',
}
SESSION_KINDS = {'poses': ('cli.pose_session', 'a session of a tracker that gives poses only')}
STREAMS = {'tracked_poses': 'nodes.pose_streams:PoseStreams'}
