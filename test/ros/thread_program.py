"""What the threads of a process have, those from before and after it asked the system for something."""

from __future__ import annotations

import subprocess
import sys

PROGRAM = """
import threading
from flexmanip_ros.ros import MODULE as module
seen = []
before = threading.Event()
early = threading.Thread(target=lambda: (before.wait(), seen.append(module.current())))
early.start()
refused = module.take(WANTED)
before.set()
early.join()
late = threading.Thread(target=lambda: seen.append(module.current()))
late.start()
late.join()
print(refused or f'{module.current()} {seen[0]} {seen[1]}')
"""


def said(module: str, wanted: object) -> str:
    """Let a process ask; return why it is refused, or what its first, an early and a late thread have."""
    program = PROGRAM.replace('MODULE', module).replace('WANTED', repr(wanted))
    command = [sys.executable, '-c', program]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=True).stdout
