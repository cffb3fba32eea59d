"""Launch the full chain: control unit or simulator, field model, tracker, recorder and servers.

ros2 launch anser_ros anser.launch.py device:=/dev/ttyACM0 setup:=my_setup.yaml
ros2 launch anser_ros anser.launch.py simulate:=true
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, GroupAction
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node, PushRosNamespace
from launch_ros.substitutions import FindPackageShare

PACKAGE = 'anser_ros'
ARGUMENTS = {
    'namespace': ('anser', 'namespace of all nodes and topics'),
    'params': ('anser.yaml', 'parameter file: a path, or a file of the package'),
    'device': ('/dev/ttyACM0', "the control unit's port"),
    'setup': ('demo_setup.yaml', 'setup document: a path, or a file of the package'),
    'channels': ('demo_channels.yaml', 'channel calibration: a path, or a file of the package'),
    'model': ('nominal', 'model file of calibrate, or nominal'),
    'board_seed': ('0', "the simulated unit's board: 0 as drawn, 1 that of demo_model.yaml"),
    'simulate': ('false', 'whether a simulated control unit replaces the real one'),
    'record': ('true', 'whether a bag is recorded'),
    'directory': ('recordings', 'folder of the bags'),
    'watch': ('false', 'whether effects that the model lacks are reported in /diagnostics'),
    'openigtlink': ('false', 'whether poses are served to 3D Slicer'),
    'rviz': ('false', 'whether RViz is started'),
}


def node(name, condition=None, **parameters):
    """Return one node with the common parameter file, and values that override it."""
    common = PathJoinSubstitution(
        [FindPackageShare(PACKAGE), 'config', LaunchConfiguration('params')]
    )
    return Node(
        package=PACKAGE,
        executable=name,
        name=name,
        parameters=[common, parameters] if parameters else [common],
        condition=IfCondition(LaunchConfiguration(condition)) if condition else None,
        output='screen',
        emulate_tty=True,
        sigterm_timeout='5',
    )


def generate_launch_description():
    """Return the nodes of the chain with the launch arguments."""
    value = LaunchConfiguration
    board = {'setup_file': value('setup'), 'channels_file': value('channels')}
    rviz_config = PathJoinSubstitution([FindPackageShare(PACKAGE), 'config', 'anser.rviz'])
    return LaunchDescription(
        [
            *(
                DeclareLaunchArgument(name, default_value=default, description=text)
                for name, (default, text) in ARGUMENTS.items()
            ),
            GroupAction(
                [
                    PushRosNamespace(value('namespace')),
                    node(
                        'cu_simulator',
                        'simulate',
                        link=value('device'),
                        board_seed=value('board_seed'),
                        **board,
                    ),
                    node('acquisition', device=value('device'), **board),
                    node('field_model', model_file=value('model')),
                    node('tracker', model_file=value('model')),
                    node('recorder', 'record', directory=value('directory')),
                    node('watcher', 'watch', model_file=value('model')),
                    node('openigtlink', 'openigtlink'),
                ]
            ),
            Node(
                package='rviz2',
                executable='rviz2',
                arguments=['-d', rviz_config],
                condition=IfCondition(value('rviz')),
            ),
        ]
    )
