"""The nodes: each converts a message, makes one call of the core and publishes."""

from importlib.util import find_spec

if find_spec('rclpy') is None:
    raise ModuleNotFoundError(
        "the nodes and the demo need rclpy, which is not installed; source a ROS installation, or run "
        "pip install 'flexmanip_ros[ros]'. identify_bag, simulate_bag, monte_carlo, reproduce_paper and write_urdf "
        'run without it', name='rclpy')
