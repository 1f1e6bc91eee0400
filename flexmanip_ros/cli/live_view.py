"""live_view: see the arm live in a browser, or a recording of it. Without a recording it is a ROS node."""

from __future__ import annotations

import argparse
import sys
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from flexmanip_ros.cli import console
from flexmanip_ros.errors import FlexmanipError
from flexmanip_ros.io.parameter_file import load
from flexmanip_ros.parameters import IdentifierParameters
from flexmanip_ros.parameters.document import help_text
from flexmanip_ros.parameters.nodes import PORT, ViewParameters

if TYPE_CHECKING:
    from flexmanip_ros.cli.replay import Request
    from flexmanip_ros.view.screen import Screen

PROG = 'live_view'
LARGEST_PORT = 65535
MOST_ROWS = 1_000_000
"""Largest number of samples in the page: a quarter of an hour at 1 kHz; a longer recording is thinned out."""
EPILOG = """without a recording, as a node (ROS must run):
  live_view --ros-args -p port:=8765
  subscribes to joint_states, capture_event, capture_detected and rpbsid_identifier/status; only listens.

exit status: 0 when it is interrupted (Ctrl-C), 130 before the page is there; 2 on bad input or arguments, with one
line on stderr.

parameters of the node:
"""


def _parser() -> console.Parser:
    made = console.parser(PROG, 'Show a recording in a browser: the arm, its signals, modes and payload.',
                          EPILOG + help_text(ViewParameters))
    made.add_argument('bag', metavar='BAG', nargs='?',
                      help='rosbag2 directory, or the .mcap or .db3 file itself; none: live, as a node')
    console.add_parameters(made, 'rpbsid_identifier')
    made.add_argument('--speed', metavar='FACTOR', type=_speed, default=1.0,
                      help='how many times as fast as it was recorded (default: %(default)s); the page can change it')
    made.add_argument('--port', metavar='PORT', type=console.whole, default=PORT,
                      help='port of the page on this machine; 0: any that is free (default: %(default)s)')
    made.add_argument('--joint-states', metavar='TOPIC', default='joint_states',
                      help='topic of the joint states; default: joint_states, in any namespace')
    return made


def _speed(text: str) -> float:
    try:
        return console.positive_seconds(text)
    except argparse.ArgumentTypeError:
        raise argparse.ArgumentTypeError(f"'{text}' is no speed; give a factor above 0, such as 2") from None


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program; return its exit status."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    if not given or given[0] == '--ros-args':
        try:
            from flexmanip_ros.ros.nodes import live_view
        except ModuleNotFoundError as error:
            return console.print_error(PROG, f'the live view is a ROS node, and {error.name} is not installed; '
                                       'install ROS, or give a recording, which needs none')
        return live_view.main([sys.argv[0], *given])
    options = _parser().parse_args(given)
    if options.bag is None:
        _parser().error('no recording is given; as a node it takes its parameters behind --ros-args')
    if options.port > LARGEST_PORT:
        _parser().error(f'argument --port: {options.port} is more than {LARGEST_PORT}')
    return console.run(PROG, lambda: _play(options))


def _play(options: argparse.Namespace) -> int:
    from flexmanip_ros.io.bag import Topics, check

    config = load(IdentifierParameters, 'rpbsid_identifier', options.params, options.set)
    check(options.bag)  # what follows takes a second to import
    from flexmanip_ros.cli.replay import Request
    from flexmanip_ros.view.screen import Screen, of_identifier, page
    from flexmanip_ros.view.server import Server

    screen = Screen(of_identifier(config, Path(options.bag).name))
    with console.progress('identifying', 'messages') as progress, console.announced():
        fault = read(Request(options.bag, config, Topics(options.joint_states)), screen, progress)
    if fault is not None:
        console.print_error(PROG, fault)
    server = Server(page(screen.source, screen.frame(MOST_ROWS), options.speed), options.port)
    try:
        print(f'{server.invitation}; Ctrl-C ends', flush=True)
        threading.Event().wait()
    except KeyboardInterrupt:
        return console.SUCCESS
    finally:
        server.close()
    return console.SUCCESS


def read(request: Request, screen: Screen, progress: console.Report) -> FlexmanipError | None:
    """Identify a recording and show it on the screen, events as in identify_bag; return what was wrong with it.

    Of a damaged recording everything before the damage is shown. Raises SignalError when no message can be used, and
    BagError when there is none.
    """
    from flexmanip_ros import pipeline
    from flexmanip_ros.cli.replay import Messages

    messages = Messages(request, progress, screen)
    for _, estimate in pipeline.replay(request.config, messages):
        if estimate is not None:
            screen.estimate(estimate)
    if messages.fault is not None and not screen.samples:
        raise messages.fault
    return messages.fault


if __name__ == '__main__':
    sys.exit(main())
