"""The four nodes, one process each: the arm, its excitation, the capture and the identifier.

    ros2 launch flexmanip_ros demo.launch.py capture_time:=3.0 payload_mass:=20.0 view:=true

With view:=true a browser on this machine shows the run; the log has the address. The identifier logs the payload when
it is first trusted. With the executable `demo` the same nodes share one process, a bag is recorded and a picture drawn.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

PACKAGE = 'flexmanip_ros'
ARGUMENTS = (
    # name, default, words
    ('rate', '1000.0', 'samples a second [Hz]'),
    ('payload_mass', '20.0', 'mass of the object [kg]'),
    ('capture_time', '3.0', 'capture this long after the first sample [s]; negative: never'),
    ('release_time', '-1.0', 'release this long after the first sample [s]; negative: never'),
    ('payload_method', 'structured', 'none | block | frequency | structured'),
    ('view', 'false', 'show the run live in a browser on this machine (node live_view)'),
    ('view_port', '8765', 'port of that page; 0: any that is free'),
    ('namespace', '', 'namespace of all nodes'),
    ('prefix', '', "command before the identifier's own, such as 'taskset -c 1' or 'chrt -f 20'"),
    ('log_level', 'info', 'debug | info | warn | error'),
)

CHOICES = {'view': ('true', 'false', 'True', 'False', '1', '0'),
           'payload_method': ('none', 'block', 'frequency', 'structured')}
NUMBERS = {'rate': float, 'payload_mass': float, 'capture_time': float, 'release_time': float, 'view_port': int}
"""A bad value of these would end one node, or the launch once some nodes have been started, and leave the others."""


def check_numbers(context):
    """Stop the launch before the first node when an argument is no number."""
    for name, kind in NUMBERS.items():
        given = LaunchConfiguration(name).perform(context)
        try:
            kind(given)
        except ValueError:
            raise RuntimeError(f"{name}:={given} is no number; give one, such as {name}:={DEFAULTS[name]}") from None
    return []


DEFAULTS = {name: default for name, default, _ in ARGUMENTS}


def _number(name):
    return ParameterValue(LaunchConfiguration(name), value_type=float)


def _node(executable, parameters, **more):
    return Node(
        package=PACKAGE, executable=executable, namespace=LaunchConfiguration('namespace'), output='screen',
        parameters=[parameters], arguments=['--ros-args', '--log-level', LaunchConfiguration('log_level')], **more)


def generate_launch_description():
    """Return the nodes with their arguments."""
    return LaunchDescription([
        *(DeclareLaunchArgument(name, default_value=default, description=words, choices=CHOICES.get(name))
          for name, default, words in ARGUMENTS),
        OpaqueFunction(function=check_numbers),
        _node('rpbsid_identifier', {
            'payload_method': ParameterValue(LaunchConfiguration('payload_method'), value_type=str)},
            prefix=LaunchConfiguration('prefix')),
        _node('capture_trigger', {
            'mode': 'time', 'capture_time': _number('capture_time'), 'release_time': _number('release_time')}),
        _node('excitation', {'rate': _number('rate'), 'clock': 'joint_states'}),
        _node('live_view', {'port': ParameterValue(LaunchConfiguration('view_port'), value_type=int)},
              condition=IfCondition(LaunchConfiguration('view'))),
        _node('plant_simulator', {'rate': _number('rate'), 'payload_mass': _number('payload_mass')}),
    ])
