"""write_urdf: describe the arm as URDF, for robot_state_publisher and RViz."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from flexmanip_ros.arm.urdf import urdf
from flexmanip_ros.cli import console
from flexmanip_ros.errors import FlexmanipError
from flexmanip_ros.io.parameter_file import load
from flexmanip_ros.parameters import PlantParameters

PROG = 'write_urdf'
EXAMPLES = """examples:
  write_urdf --params config/arms/reference.yaml --output arm.urdf
  write_urdf --set 'arm.link_length=[1.0, 0.8]' --segments 20 > arm.urdf

exit status: 0 on success; 2 on bad arguments, with one line on stderr.
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Write the URDF to a file or to the standard output; 2 on bad input."""
    parser = console.parser(PROG, 'Describe the arm as URDF; its links bend with the joint states.', EXAMPLES)
    parser.add_argument('--params', metavar='FILE.yaml', help='ROS parameter file with the arm')
    parser.add_argument('--set', metavar='name=value', action='append', default=[], help='override one parameter')
    parser.add_argument('--segments', metavar='N', type=int, default=12, help='pieces of each link, default: 12')
    parser.add_argument('--output', metavar='FILE', help='default: standard output')
    options = parser.parse_args(arguments)
    try:
        config = load(PlantParameters, 'plant_simulator', options.params, options.set)
        text = urdf(config.arm, options.segments)
        if options.output:
            Path(options.output).write_text(text, encoding='utf-8')
        else:
            print(text, end='')
    except FlexmanipError as error:
        print(f'{PROG}: {error}', file=sys.stderr)
        return 2
    except OSError as error:
        print(f'{PROG}: {options.output} cannot be written: {error.strerror}', file=sys.stderr)
        return 2
    return 0


if __name__ == '__main__':
    sys.exit(main())
