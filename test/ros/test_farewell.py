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


LIFE = """
import os, signal
from pathlib import Path
from flexmanip_ros.ros import excitation, spin
def asked() -> bool:  # the first look of the loop: from there on a signal is graceful
    os.kill(os.getpid(), signal.SIGINT)
    return False
loop = spin.spin
spin.spin = lambda executor, context, interrupt: loop(executor, context, interrupt, asked)
excitation.main(['excitation'])
print(*(path.read_text().strip() for path in Path('/proc/self/task').glob('*/comm')))
"""


def test_a_node_takes_its_participant_along() -> None:
    """Fast DDS's threads beyond a node's end write into freed memory when the process exits."""
    command = [sys.executable, '-c', LIFE]
    life = subprocess.run(command, capture_output=True, text=True, timeout=100, check=True)
    threads = life.stdout.split()
    assert 'dds.shm.wdog' in threads
    assert [name for name in threads if name.startswith(('dds.udp', 'dds.ev', 'dds.asyn'))] == []


def ended(limit: float, takes: float) -> 'subprocess.CompletedProcess[str]':
    command = [sys.executable, '-c', PROGRAM.format(limit=limit, takes=takes)]
    return subprocess.run(command, capture_output=True, text=True, timeout=50, check=False)


def test_what_takes_too_long_ends_the_process() -> None:
    hung = ended(limit=0.2, takes=60.0)
    assert (hung.returncode, hung.stdout) == (1, '')
    assert 'Timeout' in hung.stderr


def test_what_ends_in_time_goes_on() -> None:
    assert ended(limit=30.0, takes=0.0).stdout == 'left\n'
