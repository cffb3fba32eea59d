"""Launch the full chain: control unit or simulator, field model, tracker, recorder and servers.

ros2 launch anser_ros anser.launch.py device:=/dev/ttyACM0 setup:=my_setup.yaml
ros2 launch anser_ros anser.launch.py simulate:=true baseline:=clean.mcap openigtlink:=true
ros2 launch anser_ros anser.launch.py replay:=recordings/scan model:=my_model.yaml
"""

from pathlib import Path

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, GroupAction, OpaqueFunction, Shutdown
from launch.conditions import IfCondition, UnlessCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node, PushRosNamespace
from launch_ros.parameter_descriptions import ParameterValue

from anser_ros.apps.dashboard.extension import LIVE_VIEW
from anser_ros.apps.slicer.extension import OPENIGTLINK
from anser_ros.cli.commands import NODES
from anser_ros.errors import BagError
from anser_ros.nodes.runtime.parameters import checked
from anser_ros.wire.text_files import config_path

PACKAGE = 'anser_ros'
# Exit code of a node that refuses its arguments or parameters, which it does before it starts.
REFUSED = 2
DEVICE = '/dev/ttyACM0'
# Anybody may make a link there; one for each namespace, so that two boards can be simulated.
SIMULATED = '/tmp/anser_cu_{namespace}'
ARGUMENTS = {
    'namespace': ('anser', 'namespace of all nodes and topics'),
    'params': ('anser.yaml', 'parameter file: a path, or a file of the package'),
    'device': ('', f"the control unit's port; {DEVICE} or, simulated, {SIMULATED} by default"),
    'setup': ('demo_setup.yaml', 'setup document: a path, or a file of the package'),
    'channels': ('demo_channels.yaml', 'channel calibration: a path, or a file of the package'),
    'model': ('nominal', 'model: a path, or a file of the package; or nominal'),
    'allow_uncalibrated': ('', 'whether the nominal model gives poses; true where simulated'),
    'baseline': ('', 'distortion-free recording of the board; empty: call set_baseline'),
    'board_seed': ('0', "the simulated unit's board: 0 as drawn, 1 that of demo_model.yaml"),
    'simulate': ('false', 'whether a simulated control unit replaces the real one'),
    'replay': ('', 'bag that is played in place of a control unit'),
    'composed': ('true', 'whether acquisition, field model and tracker are one process, live'),
    'optical': ('/optical', 'namespace of the optical poses'),
    'frame_prefix': ('', 'prefix of the frames of poses, clouds, metal and /tf'),
    'record': ('', 'whether a bag is recorded; by default true, but for a replay'),
    'directory': ('recordings', 'folder of the bags'),
    'watch': ('false', 'whether effects that the model lacks are reported in /diagnostics'),
    'dashboard': ('false', 'whether the live view is served to a browser on this machine'),
    'dashboard_port': (str(LIVE_VIEW), 'TCP port of the live view'),
    'openigtlink': ('false', 'whether poses are served to 3D Slicer'),
    'igtl_host': ('127.0.0.1', 'address that OpenIGTLink is served on; 0.0.0.0 for all'),
    'igtl_port': (str(OPENIGTLINK), 'TCP port of OpenIGTLink'),
    'rviz_config': ('anser.rviz', 'view of anser views: a path, or a file of the package'),
    'rviz': ('false', 'whether RViz is started'),
}


def find_files(context):
    """Put the paths of parameter file, model and port in place of what was given for them.

    A parameter file that is none, or names a node that there is not, ends the launch with a line.
    """
    given = context.launch_configurations
    given['rviz_config'] = str(config_path(given['rviz_config']))
    given['params'] = checked(given['params'], list(NODES))
    if given['model'] != 'nominal':
        given['model'] = str(config_path(given['model']))
    # As IfCondition reads it.
    is_simulated = given['simulate'].lower() in ('true', '1')
    given['allow_uncalibrated'] = given['allow_uncalibrated'] or str(is_simulated).lower()
    is_played = bool(given['replay'])
    if is_played:
        bag = Path(given['replay']).expanduser().absolute()
        if not bag.exists():
            raise BagError(f'{bag}: no such bag')
        given.update(replay=str(bag), simulate='false', composed='false')
    given['record'] = given['record'] or str(not is_played).lower()
    given['is_played'] = str(is_played).lower()
    is_apart = given['composed'].lower() not in ('true', '1')
    given['is_acquired'] = str(is_apart and not is_played).lower()
    if not given['device']:
        simulated = SIMULATED.format(namespace=given['namespace'].strip('/').replace('/', '_'))
        given['device'] = simulated if is_simulated else DEVICE


def end_all_if_refused(event, context):
    """End the launch where a process refused its parameters, for without it the chain is none."""
    if event.returncode != REFUSED:
        return None
    return [Shutdown(reason=f'{event.process_name} refuses what it was given, see its line')]


def process(name, condition=None, arguments=(), **parameters):
    """Return a process with the common parameter file, and values that override it.

    It is not given a name: that of `live` would be each of its nodes'.
    """
    common = LaunchConfiguration('params')
    return Node(
        package=PACKAGE,
        executable=name,
        parameters=[common, parameters] if parameters else [common],
        arguments=list(arguments),
        condition=condition,
        output='screen',
        emulate_tty=True,
        sigterm_timeout='5',
        on_exit=end_all_if_refused,
    )


def generate_launch_description():
    """Return the nodes of the chain with the launch arguments."""
    value = LaunchConfiguration

    def wanted(name):
        return IfCondition(value(name))

    apart = UnlessCondition(value('composed'))
    board = {'setup_file': value('setup'), 'channels_file': value('channels')}
    model = {'model_file': value('model')}
    baseline = {
        'baseline_file': ParameterValue(value('baseline'), value_type=str),
        'allow_uncalibrated': ParameterValue(value('allow_uncalibrated'), value_type=bool),
    }
    optical = {'optical': value('optical')}
    prefix = {'frame_prefix': ParameterValue(value('frame_prefix'), value_type=str)}
    return LaunchDescription(
        [
            *(
                DeclareLaunchArgument(name, default_value=default, description=text)
                for name, (default, text) in ARGUMENTS.items()
            ),
            OpaqueFunction(function=find_files),
            GroupAction(
                [
                    PushRosNamespace(value('namespace')),
                    process(
                        'cu_simulator',
                        wanted('simulate'),
                        link=value('device'),
                        board_seed=value('board_seed'),
                        **optical,
                        **board,
                        **prefix,
                    ),
                    process(
                        'live',
                        wanted('composed'),
                        device=value('device'),
                        **board,
                        **model,
                        **baseline,
                        **prefix,
                    ),
                    process('replay', wanted('is_played'), [value('replay')], **optical),
                    process(
                        'acquisition',
                        wanted('is_acquired'),
                        device=value('device'),
                        **board,
                        **prefix,
                    ),
                    process('field_model', apart, **model, **baseline, **prefix),
                    process('tracker', apart, **model, **prefix),
                    process('recorder', wanted('record'), directory=value('directory'), **optical),
                    process(
                        'dashboard',
                        wanted('dashboard'),
                        directory=value('directory'),
                        **optical,
                        port=value('dashboard_port'),
                    ),
                    process('watcher', wanted('watch'), **optical, **model),
                    process(
                        'openigtlink',
                        wanted('openigtlink'),
                        host=value('igtl_host'),
                        port=value('igtl_port'),
                    ),
                ]
            ),
            Node(
                package='rviz2',
                executable='rviz2',
                arguments=['-d', value('rviz_config')],
                condition=wanted('rviz'),
            ),
        ]
    )
