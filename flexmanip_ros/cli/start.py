"""The way into every program: a signal ends it without a traceback from its first line on.

The imports of a node take a second on a busy machine. Python's own answer to Ctrl-C is an exception, which
ends in a maze of tracebacks when it comes in the midst of an import.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable
from types import FrameType

Main = Callable[[], int]


def _program(where: str, *, unfinished: bool) -> Main:
    """Return the main function of a module, imported only when it is called.

    unfinished: end with 128 + the signal's number; else with 0, as a node that was asked to stop.
    """
    def end(number: int, frame: FrameType | None) -> None:
        os._exit(128 + number if unfinished else 0)

    def main() -> int:
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, end)
        __import__(where)
        return int(sys.modules[where].main())

    return main


def _node(name: str) -> Main:
    return _program(f'flexmanip_ros.ros.nodes.{name}', unfinished=False)


def _tool(name: str, package: str = 'cli') -> Main:
    return _program(f'flexmanip_ros.{package}.{name}', unfinished=True)


plant_simulator = _node('plant_simulator')
excitation = _node('excitation')
capture_trigger = _node('capture_trigger')
rpbsid_identifier = _node('rpbsid_identifier')
payload_controller = _node('payload_controller')
payload_adapter = _node('payload_adapter')
demo = _tool('program', 'ros.demo')
identify_bag = _tool('identify_bag')
simulate_bag = _tool('simulate_bag')
reproduce_paper = _tool('reproduce_paper')
monte_carlo = _tool('monte_carlo')
write_urdf = _tool('write_urdf')
