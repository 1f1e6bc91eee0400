"""The arm in RViz: its joint states through a URDF made from the parameters arm.*, and the identifier's ~/arm.

ros2 launch flexmanip_ros view.launch.py params_file:=my_arm.yaml
"""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from flexmanip_ros.cli.write_urdf import urdf
from flexmanip_ros.io.parameter_file import load_arm


def describe(context):
    """Make the URDF once the arguments are known."""
    path = LaunchConfiguration('params_file').perform(context) or None
    return [
        Node(package='robot_state_publisher', executable='robot_state_publisher', output='screen',
             parameters=[{'robot_description': urdf(load_arm(path))}],
             remappings=[('joint_states', LaunchConfiguration('joint_states'))]),
        Node(package='rviz2', executable='rviz2', output='screen',
             arguments=['--display-config', LaunchConfiguration('layout')],
             condition=IfCondition(LaunchConfiguration('rviz'))),
    ]


def generate_launch_description():
    """Return robot_state_publisher and, unless it is turned off, RViz."""
    layout = Path(get_package_share_directory('flexmanip_ros')) / 'config' / 'layouts' / 'arm.rviz'
    return LaunchDescription([
        DeclareLaunchArgument('params_file', default_value='',
                              description='parameter file of the plant or the identifier, with the arm; default: the '
                                          'reference arm'),
        DeclareLaunchArgument('joint_states', default_value='joint_states',
                              description='topic of the joint states'),
        DeclareLaunchArgument('rviz', default_value='true', description='start RViz too'),
        DeclareLaunchArgument('layout', default_value=str(layout),
                              description='display configuration of RViz; default: config/layouts/arm.rviz'),
        OpaqueFunction(function=describe),
    ])
