"""The programs that need no ROS running."""
