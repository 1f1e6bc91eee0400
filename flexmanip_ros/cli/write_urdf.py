"""write_urdf: describe the arm as URDF, for robot_state_publisher and RViz."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from flexmanip_ros.cli import console
from flexmanip_ros.io.parameter_file import load_arm

PROG = 'write_urdf'
EXAMPLES = """examples:
  write_urdf --params config/arms/reference.yaml --output arm.urdf
  write_urdf --set 'arm.link_length=[1.0, 0.8]' --segments 20 > arm.urdf

exit status: 0 on success; 2 on bad arguments, with one line on stderr.
"""


def _parser() -> console.Parser:
    made = console.parser(
        PROG, 'Write the arm as URDF. Its links are chains of segments that bend with the joint states.', EXAMPLES)
    console.add_parameters(made, 'plant_simulator or rpbsid_identifier')
    made.add_argument('--segments', metavar='N', type=int, default=12, help='segments of each link; default: 12')
    made.add_argument('--output', metavar='FILE', help='file to write; default: standard output')
    return made


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program; return its exit status."""
    given = _parser().parse_args(arguments)
    return console.run(PROG, lambda: _main(given))


def _main(given: argparse.Namespace) -> int:
    from flexmanip_ros.arm.urdf import urdf
    from flexmanip_ros.io.outputs import write_text

    text = urdf(load_arm(given.params, given.set), given.segments)
    if given.output:
        write_text(given.output, text)
    else:
        print(text, end='')
    return console.SUCCESS


if __name__ == '__main__':
    sys.exit(main())
