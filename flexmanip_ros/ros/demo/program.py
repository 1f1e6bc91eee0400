"""Program ``demo``: the arm catches something, live, and is recorded, drawn and replayed.

Plant, excitation, capture trigger and identifier run as ROS nodes over DDS against the wall clock. A new
folder below OUTPUT gets the bag (mcap) and the picture; replaying that bag must give the live numbers bit for
bit.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import rclpy
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args
from rich.console import Console

from flexmanip_ros.errors import FlexmanipError, ParameterError
from flexmanip_ros.parameters import DemoParameters, configure, leaves
from flexmanip_ros.ros.demo.composition import Composition, foreign_arm
from flexmanip_ros.ros.demo.composition import arguments as composition_arguments
from flexmanip_ros.ros.demo.progress import Progress
from flexmanip_ros.ros.demo.result import finish
from flexmanip_ros.ros.spin import (
    BAD_INPUT,
    FAREWELL_S,
    Interrupt,
    bury,
    first_line,
    make_executor,
    spin,
    time_limit,
)

NAME = 'demo'
LOOK_AROUND_S = 0.5
"""Time for an arm that is on the domain already to be noticed."""
FAILED = 1


def main(argv: Sequence[str] | None = None) -> int:
    """Run the demonstration; return 0, 1 when live and replay differ or it could not run, 2 for bad input."""
    arguments = list(sys.argv if argv is None else argv)
    interrupt = Interrupt(exit_with_signal=True)
    interrupt.install()
    try:
        options = parser().parse_args(remove_ros_args(arguments)[1:])
    except RuntimeError as error:  # --ros-args that rcl cannot read
        return _refuse(first_line(error), BAD_INPUT)
    console = Console(highlight=False, soft_wrap=True)
    try:
        config = configure(DemoParameters, {
            leaf.name: getattr(options, leaf.name) for leaf in leaves(DemoParameters)})
        folder = new_folder(Path(options.output))
    except ParameterError as error:
        return _refuse(str(error), BAD_INPUT)
    except OSError as error:
        problem = f"'{options.output}' cannot be written: {error.strerror}; give another folder"
        return _refuse(problem, BAD_INPUT)
    # A demonstration must never reach a robot on the network.
    os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    try:
        _init([arguments[0], *composition_arguments(config), *arguments[1:]], console)
    except Exception as error:  # rcl raises types of its C extension for --ros-args and parameter files
        return _refuse(first_line(error), BAD_INPUT)
    try:
        return _run(config, folder, console, interrupt)
    except ParameterError as error:
        return _refuse(str(error), BAD_INPUT)
    except FlexmanipError as error:
        return _refuse(str(error), FAILED)
    finally:
        with time_limit(FAREWELL_S):
            rclpy.try_shutdown()
            bury()


def _run(config: DemoParameters, folder: Path, console: Console, interrupt: Interrupt) -> int:
    console.print('Starting the nodes (the first time, kernels are compiled)')
    began = time.monotonic()
    composition = Composition(config, folder / 'bag')
    interrupt.install()
    try:
        composition.configure()
        interrupt.graceful = True  # from here on there is a bag to be closed
        composition.connect(lambda: interrupt.raised)
        console.print(
            f'Ready after {time.monotonic() - began:.1f} s: plant_simulator, excitation, capture_trigger, '
            f'rpbsid_identifier over {rclpy.utilities.get_rmw_implementation_identifier()}')
        composition.start()
        progress = Progress(console, composition)
        spin(composition.executor, None, interrupt, until=progress.update)
        progress.end()
        composition.drain()
        facts = composition.facts()
    finally:
        composition.close()
    interrupt.graceful = False
    if interrupt.raised:
        console.print(f"interrupted after {facts.seconds:.1f} s; the bag so far is '{folder / 'bag'}'")
        return interrupt.exit_code
    return finish(config, facts, folder, console)


def parser() -> argparse.ArgumentParser:
    """Return the arguments: an output folder and every parameter of the demonstration."""
    made = argparse.ArgumentParser(
        prog=NAME, description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog='parameters of the nodes: demo --ros-args -p rpbsid_identifier:order:=4')
    made.add_argument('output', nargs='?', default='demo_output',
                      help='folder that gets a new numbered folder for this run (default: %(default)s)')
    for leaf in leaves(DemoParameters):
        unit = f' [{leaf.unit}]' if leaf.unit else ''
        made.add_argument('--' + leaf.name.replace('_', '-'), type=leaf.kind, default=leaf.default,
                          metavar=leaf.name.upper(), help=f'{leaf.words}{unit} (default: %(default)s)')
    return made


def new_folder(base: Path) -> Path:
    """Make and return ``base/run_NNN`` with the next free number; nothing is ever overwritten."""
    base.mkdir(parents=True, exist_ok=True)
    numbers = [path.name[4:] for path in base.glob('run_*')]
    number = 1 + max((int(text) for text in numbers if text.isdigit()), default=0)
    while True:
        try:
            (base / f'run_{number:03d}').mkdir()
        except FileExistsError:
            number += 1
        else:
            return base / f'run_{number:03d}'


def _init(arguments: Sequence[str], console: Console) -> None:
    """Join a domain without an arm on it: the user's own, or else the next free one."""
    domain: int | None = None
    for _ in range(10):
        rclpy.init(args=list(arguments), signal_handler_options=SignalHandlerOptions.NO, domain_id=domain)
        if not _occupied():
            if domain is not None:
                console.print(f'another arm is on the usual domain; this one is on ROS_DOMAIN_ID={domain}')
            return
        rclpy.shutdown()
        domain = (os.getpid() + (domain or 0)) % 100 + 1
    raise ParameterError('no free ROS domain was found', 'set ROS_DOMAIN_ID')


def _occupied() -> bool:
    """Look around for somebody else's joint states and efforts."""
    node: Any = Node('demo_lookout')
    executor = make_executor()
    executor.add_node(node)
    limit = time.monotonic() + LOOK_AROUND_S
    found = False
    while time.monotonic() < limit and not found:
        executor.spin_once(timeout_sec=0.05)
        found = foreign_arm(node, own_writers=0, own_readers=0)
    executor.shutdown()
    node.destroy_node()
    return found


def _refuse(problem: str, code: int) -> int:
    print(f'{NAME}: {problem}', file=sys.stderr)
    return code


if __name__ == '__main__':
    sys.exit(main())
