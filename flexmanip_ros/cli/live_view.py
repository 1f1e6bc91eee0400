"""live_view: see the arm live in a browser, or a recording of it. Without a recording it is a ROS node."""

from __future__ import annotations

import argparse
import sys
import threading
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flexmanip_ros.cli import console
from flexmanip_ros.errors import BagError, ParameterError
from flexmanip_ros.io.parameter_file import load
from flexmanip_ros.parameters import IdentifierParameters
from flexmanip_ros.parameters.document import help_text
from flexmanip_ros.parameters.nodes import PORT, ViewParameters

if TYPE_CHECKING:
    from flexmanip_ros import pipeline
    from flexmanip_ros.view.screen import Source

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
    value = console.seconds(text)
    if value <= 0.0:
        raise argparse.ArgumentTypeError(f"'{text}' is no speed; give a factor above 0, such as 2")
    return value


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program; return its exit status."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    if not given or given[0] == '--ros-args':
        try:
            from flexmanip_ros.ros.nodes import live_view
        except ModuleNotFoundError as error:
            console.print_error(PROG, f'the live view is a ROS node, and {error.name} is not installed; install ROS, '
                                'or give a recording, which needs none')
            return console.BAD_INPUT
        return live_view.main([sys.argv[0], *given])
    options = _parser().parse_args(given)
    if options.bag is None:
        _parser().error('no recording is given; as a node it takes its parameters behind --ros-args')
    if options.port > LARGEST_PORT:
        _parser().error(f'argument --port: {options.port} is more than {LARGEST_PORT}')
    return console.run(PROG, lambda: _play(options))


def _play(options: argparse.Namespace) -> int:
    from flexmanip_ros.io import bag
    from flexmanip_ros.payload import capture_detection
    from flexmanip_ros.view.screen import of_identifier, page
    from flexmanip_ros.view.server import Server

    config = load(IdentifierParameters, 'rpbsid_identifier', options.params, options.set)
    source = of_identifier(config, Path(options.bag).name)
    topics = bag.Topics(options.joint_states)
    with console.progress('identifying', 'messages') as progress, console.announced():
        items: Iterable[pipeline.Item] = bag.read_blocks(options.bag, topics, progress)
        if config.payload_method != 'none' and not bag.event_topics(options.bag, topics):
            with suppress(ParameterError):  # as in identify_bag, captures are looked for in signals that can show them
                items = capture_detection.with_detected(capture_detection.watch(config), items)
        found, fault = read(config, items, source)
    if fault is not None:
        console.print_error(PROG, fault)
    server = Server(page(source, found, options.speed), options.port)
    try:
        print(f'{server.invitation}; Ctrl-C ends', flush=True)
        threading.Event().wait()
    except KeyboardInterrupt:
        return console.SUCCESS
    finally:
        server.close()
    return console.SUCCESS


def read(config: IdentifierParameters, items: Iterable[pipeline.Item], source: Source
         ) -> tuple[dict[str, Any], BagError | None]:
    """Identify a recording; return what the page shows of it, and what was wrong with it.

    Of a damaged recording everything before the damage is shown. Raises SignalError when no message can be used, and
    BagError when there is none.
    """
    from flexmanip_ros import pipeline
    from flexmanip_ros.types import CaptureEvent, JointBlock
    from flexmanip_ros.view.screen import Screen

    screen = Screen(source)
    fault: BagError | None = None

    def tapped() -> Iterator[pipeline.Item]:
        nonlocal fault
        try:
            for item in items:
                if isinstance(item, CaptureEvent):
                    screen.event(item)
                else:
                    screen.joint_states(item if isinstance(item, JointBlock) else JointBlock.of(item))
                yield item
        except BagError as error:
            if not screen.samples:
                raise
            fault = error

    for _, estimate in pipeline.replay(config, tapped()):
        if estimate is not None:
            screen.estimate(estimate)
    return screen.frame(MOST_ROWS), fault


if __name__ == '__main__':
    sys.exit(main())
