"""The arm in RViz: its joint states through a URDF made from the parameters arm.*, and the identifier's ~/arm.

ros2 launch flexmanip_ros view.launch.py params_file:=my_arm.yaml
"""

import tempfile
from pathlib import Path

import yaml
from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from flexmanip_ros.cli.write_urdf import urdf
from flexmanip_ros.io.parameter_file import load_arm

YES_OR_NO = 'true', 'false', 'True', 'False', '1', '0'
"""launch tells of another word only once a node has been started, and leaves it running."""
REACH = 6.0
"""Length of the arm [m] that config/layouts/arm.rviz is made for, the reference arm."""


def scaled(layout, reach):
    """Return the path of a copy of the layout for an arm of this length [m]; launch_ros makes files there, too."""
    content = yaml.safe_load(Path(layout).read_text(encoding='utf-8'))
    manager, size = content['Visualization Manager'], reach / REACH
    camera = manager['Views']['Current']
    camera.update(Scale=camera['Scale'] / size, X=camera['X'] * size, Y=camera['Y'] * size)
    manager['Displays'][0]['Cell Size'] *= size
    with tempfile.NamedTemporaryFile('w', encoding='utf-8', suffix='.rviz', delete=False) as file:
        yaml.safe_dump(content, file)
    return file.name


def describe(context):
    """Make the URDF and the layout once the arguments are known."""
    path = LaunchConfiguration('params_file').perform(context) or None
    arm = load_arm(path)
    namespace = LaunchConfiguration('namespace').perform(context).strip('/')
    layout = LaunchConfiguration('layout').perform(context)
    if layout == default_layout():
        layout = scaled(layout, sum(arm.link_length))
    remappings = [] if not namespace else [(name, f'/{namespace}{name}') for name in (
        '/robot_description', '/rpbsid_identifier/arm')]
    return [
        Node(package='robot_state_publisher', executable='robot_state_publisher', output='screen',
             namespace=namespace, parameters=[{'robot_description': urdf(arm)}],
             remappings=[('joint_states', LaunchConfiguration('joint_states'))]),
        Node(package='rviz2', executable='rviz2', output='screen',
             arguments=['--display-config', layout], remappings=remappings,
             condition=IfCondition(LaunchConfiguration('rviz'))),
    ]


def default_layout():
    """Return the path of the layout of this package."""
    return str(Path(get_package_share_directory('flexmanip_ros')) / 'config' / 'layouts' / 'arm.rviz')


def generate_launch_description():
    """Return robot_state_publisher and, unless it is turned off, RViz."""
    return LaunchDescription([
        DeclareLaunchArgument('params_file', default_value='',
                              description='parameter file of the plant or the identifier, with the arm; default: the '
                                          'reference arm'),
        DeclareLaunchArgument('joint_states', default_value='joint_states',
                              description='topic of the joint states'),
        DeclareLaunchArgument('namespace', default_value='', description='namespace of the arm and its identifier'),
        DeclareLaunchArgument('rviz', default_value='true', choices=YES_OR_NO, description='start RViz too'),
        DeclareLaunchArgument('layout', default_value=default_layout(),
                              description='display configuration of RViz; default: config/layouts/arm.rviz'),
        OpaqueFunction(function=describe),
    ])
