"""The identifier on an arm that publishes joint_states already.

ros2 launch flexmanip_ros identify.launch.py params_file:=my_arm.yaml joint_states:=/arm/joint_states
"""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterFile, ParameterValue

PACKAGE = 'flexmanip_ros'


def generate_launch_description():
    """Return the identifier and, unless it is turned off, the capture trigger."""
    config = Path(get_package_share_directory(PACKAGE)) / 'config'
    remap = [('joint_states', LaunchConfiguration('joint_states'))]
    simulated = {'use_sim_time': ParameterValue(LaunchConfiguration('use_sim_time'), value_type=bool)}
    return LaunchDescription([
        DeclareLaunchArgument('params_file', default_value=str(config / 'rpbsid_identifier.yaml'),
                              description='parameter file with the arm and the signals'),
        DeclareLaunchArgument('joint_states', default_value='joint_states',
                              description='topic of the joint states'),
        DeclareLaunchArgument('namespace', default_value='', description='namespace of both nodes'),
        DeclareLaunchArgument('use_sim_time', default_value='false', description='take time from /clock'),
        DeclareLaunchArgument('trigger', default_value='true',
                              description='start capture_trigger too (services capture and release)'),
        DeclareLaunchArgument('trigger_mode', default_value='service', description='service | time | auto'),
        Node(package=PACKAGE, executable='rpbsid_identifier', namespace=LaunchConfiguration('namespace'),
             parameters=[ParameterFile(LaunchConfiguration('params_file')), simulated], remappings=remap,
             output='screen'),
        Node(package=PACKAGE, executable='capture_trigger', namespace=LaunchConfiguration('namespace'),
             parameters=[{'mode': ParameterValue(LaunchConfiguration('trigger_mode'), value_type=str)},
                         simulated],
             remappings=remap, output='screen', condition=IfCondition(LaunchConfiguration('trigger'))),
    ])
