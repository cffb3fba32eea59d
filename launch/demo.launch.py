"""Launch the demo: a simulated control unit, two trackers and a live table.

One tracker follows a field model that is refitted live, the other keeps the model as calibrated.
Without the package `launch`, `anser demo` starts the same processes.

ros2 launch anser_ros demo.launch.py duration:=30
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, EmitEvent, GroupAction, RegisterEventHandler
from launch.event_handlers import OnProcessExit
from launch.events import Shutdown
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node, PushRosNamespace
from launch_ros.substitutions import FindPackageShare

PACKAGE = 'anser_ros'
PORT = '/tmp/anser_cu'
# Seed of the board that config/demo_model.yaml was calibrated with.
BOARD_SEED = 1
SHARED_TOPICS = ('setup', 'tool/flux', 'reference/flux')
ARGUMENTS = {
    'duration': ('30.0', 'duration, from the first pose on, s; 0 for no end'),
    'directory': ('recordings', 'folder of the bag'),
    'metal': ('true', 'whether a steel disc comes and goes'),
}


def node(name, remappings=(), output='log', **parameters):
    """Return one node with its parameters."""
    return Node(
        package=PACKAGE,
        executable=name,
        name=name,
        parameters=[parameters],
        remappings=list(remappings),
        output=output,
        # No terminal: under launch every line has a prefix, which would break a live table.
        emulate_tty=False,
        sigterm_timeout='5',
    )


def live(model):
    """Return acquisition, field model and tracker in one process, a value for the node it is for.

    It is not given a name, which would be each of its nodes'.
    """
    words = [f'acquisition:device:={PORT}', 'field_model:baseline_at_start:=true']
    words.append(['field_model:model_file:=', model])
    return Node(
        package=PACKAGE,
        executable='live',
        ros_arguments=[word for text in words for word in ('-p', text)],
        output='log',
        sigterm_timeout='5',
    )


def generate_launch_description():
    """Return the nodes, all of which end when the monitor does."""
    value = LaunchConfiguration
    model = PathJoinSubstitution([FindPackageShare(PACKAGE), 'config', 'demo_model.yaml'])
    monitor = node(
        'monitor',
        output='screen',
        duration_s=value('duration'),
        compare='frozen',  # its gate is off, as a tracker's without a residual gate
    )
    shared = [(topic, f'/anser/{topic}') for topic in SHARED_TOPICS]
    return LaunchDescription(
        [
            *(
                DeclareLaunchArgument(name, default_value=default, description=text)
                for name, (default, text) in ARGUMENTS.items()
            ),
            GroupAction(
                [
                    PushRosNamespace('anser'),
                    node('cu_simulator', link=PORT, metal=value('metal'), board_seed=BOARD_SEED),
                    live(model),
                    node('recorder', directory=value('directory')),
                    GroupAction(
                        [
                            PushRosNamespace('frozen'),
                            node('field_model', shared, model_file=model),
                            node('tracker', shared, gate=1e6, adaptive=False),
                        ]
                    ),
                    monitor,
                ]
            ),
            RegisterEventHandler(
                OnProcessExit(target_action=monitor, on_exit=[EmitEvent(event=Shutdown())])
            ),
        ]
    )
