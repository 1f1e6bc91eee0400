"""The identifier on an arm that publishes joint_states already.

ros2 launch flexmanip_ros identify.launch.py params_file:=my_arm.yaml joint_states:=/arm/joint_states
"""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterFile, ParameterValue

PACKAGE = 'flexmanip_ros'
TRIGGER_MODES = 'service', 'time', 'auto'
YES_OR_NO = 'true', 'false', 'True', 'False', '1', '0'
"""launch tells of another word only once a node has been started, and leaves it running."""


def check_params_file(context):
    """Stop the launch when the parameter file is missing; launch_ros itself only warns."""
    path = LaunchConfiguration('params_file').perform(context)
    if not Path(path).is_file():
        raise RuntimeError(f"params_file '{path}' does not exist; give the path of a ROS parameter file")
    return []


def generate_launch_description():
    """Return the identifier and, unless it is turned off, the capture trigger."""
    config = Path(get_package_share_directory(PACKAGE)) / 'config'
    shared = {
        'package': PACKAGE, 'namespace': LaunchConfiguration('namespace'), 'output': 'screen',
        'remappings': [('joint_states', LaunchConfiguration('joint_states'))],
    }
    parameters = [ParameterFile(LaunchConfiguration('params_file')),
                  {'use_sim_time': ParameterValue(LaunchConfiguration('use_sim_time'), value_type=bool)}]
    mode = {'mode': ParameterValue(LaunchConfiguration('trigger_mode'), value_type=str)}
    return LaunchDescription([
        DeclareLaunchArgument('params_file', default_value=str(config / 'rpbsid_identifier.yaml'),
                              description='parameter file with the arm and the signals, for both nodes; default: '
                                          'config/rpbsid_identifier.yaml, the reference arm'),
        DeclareLaunchArgument('joint_states', default_value='joint_states',
                              description='topic of the joint states'),
        DeclareLaunchArgument('namespace', default_value='', description='namespace of both nodes'),
        DeclareLaunchArgument('use_sim_time', default_value='false', description='take time from /clock'),
        DeclareLaunchArgument('trigger', default_value='true', choices=YES_OR_NO,
                              description='start capture_trigger too (services capture and release)'),
        DeclareLaunchArgument('trigger_mode', default_value='service', choices=TRIGGER_MODES,
                              description='service | time | auto'),
        DeclareLaunchArgument('prefix', default_value='', description=(
            "command before the identifier's own, such as 'taskset -c 1' or 'chrt -f 20'")),
        OpaqueFunction(function=check_params_file),
        Node(executable='rpbsid_identifier', parameters=parameters, prefix=LaunchConfiguration('prefix'), **shared),
        Node(executable='capture_trigger', parameters=[*parameters, mode],
             condition=IfCondition(LaunchConfiguration('trigger')), **shared),
    ])
