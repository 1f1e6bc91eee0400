"""A node takes its DDS participant along, and a middleware that hangs at the end does not keep the process."""

import subprocess
import sys

LIFE = """
import os, signal
from pathlib import Path
from flexmanip_ros.ros import rclpy_workarounds
from flexmanip_ros.ros.nodes import excitation
def asked() -> bool:  # called between two callbacks
    os.kill(os.getpid(), signal.SIGINT)
    return False
spin = rclpy_workarounds.spin
rclpy_workarounds.spin = lambda executor: spin(executor, until=asked)
assert excitation.main(['excitation']) == 0
print(*(path.read_text().strip() for path in Path('/proc/self/task').glob('*/comm')))
"""
ENDING = """
import time
from flexmanip_ros.ros import rclpy_workarounds
rclpy_workarounds.LONGEST_END_S = {limit}
with rclpy_workarounds.shutdown():
    time.sleep({takes})
print('left')
"""


def test_a_node_takes_its_participant_along() -> None:
    """Fast DDS's threads beyond a node's end write into freed memory when the process exits."""
    command = [sys.executable, '-c', LIFE]
    life = subprocess.run(command, capture_output=True, text=True, timeout=100, check=True)
    threads = life.stdout.split()
    assert 'dds.shm.wdog' in threads
    assert [name for name in threads if name.startswith(('dds.udp', 'dds.ev', 'dds.asyn'))] == []


def ended(limit: float, takes: float) -> 'subprocess.CompletedProcess[str]':
    command = [sys.executable, '-c', ENDING.format(limit=limit, takes=takes)]
    return subprocess.run(command, capture_output=True, text=True, timeout=50, check=False)


def test_an_end_that_takes_too_long_ends_the_process() -> None:
    hung = ended(limit=0.2, takes=60.0)
    assert (hung.returncode, hung.stdout) == (1, '')
    assert 'Timeout' in hung.stderr


def test_an_end_in_time_goes_on() -> None:
    assert ended(limit=30.0, takes=0.0).stdout == 'left\n'
