"""A middleware that hangs while a node leaves it does not keep the process."""

import subprocess
import sys

PROGRAM = """
import time
from flexmanip_ros.ros.spin import time_limit
with time_limit({limit}):
    time.sleep({takes})
print('left')
"""


def ended(limit: float, takes: float) -> 'subprocess.CompletedProcess[str]':
    command = [sys.executable, '-c', PROGRAM.format(limit=limit, takes=takes)]
    return subprocess.run(command, capture_output=True, text=True, timeout=50, check=False)


def test_what_takes_too_long_ends_the_process() -> None:
    hung = ended(limit=0.2, takes=60.0)
    assert (hung.returncode, hung.stdout) == (1, '')
    assert 'Timeout' in hung.stderr


def test_what_ends_in_time_goes_on() -> None:
    assert ended(limit=30.0, takes=0.0).stdout == 'left\n'
