"""identify_bag: identify model and payload from a recording. ROS need not run."""

from __future__ import annotations

import argparse
import json
import sys
from functools import partial
from typing import TYPE_CHECKING

from flexmanip_ros.cli import console
from flexmanip_ros.errors import ParameterError
from flexmanip_ros.io.parameter_file import load
from flexmanip_ros.parameters import IdentifierParameters
from flexmanip_ros.parameters.document import help_text

if TYPE_CHECKING:
    from flexmanip_ros.cli.replay import Result

PROG = 'identify_bag'
NODE = 'rpbsid_identifier'
SWITCH_S = 0.0002
"""Thread switch interval of Python [s]; a kernel for the samples between two estimates takes 2 ms."""
EXAMPLES = """examples:
  identify_bag recording                                     the default arm; captures are found in the signals
                                                             where the recording has no topic of events
  identify_bag recording --params my_arm.yaml --report report.html
  identify_bag recording --set payload_method=none --set 'inputs=[motor/effort]' \\
      --set 'outputs=[arm/position]' --set order=4 --validate-from 5
  identify_bag recording --suggest my_machine.yaml --validate-from 30     any machine: what to identify it with
  identify_bag recording --output estimates.csv --json

exit status: 0 on success (stderr then tells in one line which messages were left out); 2 on bad input or
arguments, with one line on stderr; 130 when interrupted. Of a damaged recording everything before the damage is used
and written; then the damage is reported with exit status 2, and so is what the recording does not give.

parameters (in --params under rpbsid_identifier or /**, or with --set):
"""


def _parser() -> console.Parser:
    made = console.parser(
        PROG, 'Identify a flexible arm and its payload from a rosbag2 recording. ROS need not run.',
        EXAMPLES + help_text(IdentifierParameters))
    add = made.add_argument
    add('bag', metavar='BAG', help='rosbag2 directory, or the .mcap or .db3 file itself')
    console.add_parameters(made, 'rpbsid_identifier')
    add('--suggest', metavar='FILE.yaml',
        help='look at the recording, before --validate-from if that is given; choose the parameters that predict it '
        'best, those of --params and --set kept; write them and identify with them')
    add('--validate-from', metavar='SECONDS', type=console.seconds,
        help='identify on the samples before this time [s] from the first stamp; score the model on the rest')
    add('--horizon', metavar='SECONDS', type=console.positive_seconds,
        help='with --validate-from, score the prediction this far ahead too [s]; default: 0.25')
    add('--smooth', action='store_true',
        help='also fit each stretch between events with all of its samples, later ones too')
    add('--output', metavar='OUT',
        help='write the estimates: a table where the name ends in .csv or .npz, else a rosbag2 recording')
    add('--report', metavar='REPORT.html', help='write a report: one HTML page with figures and tables')
    add('--save-arm', metavar='FILE.yaml',
        help='write the parameters of the arm, with what it taught (stiffness, damping, friction, rotors, gains, '
        'offsets, delays), as a parameter file')
    add('--configurations', metavar='FILE.csv',
        help='write frequencies and damping over the angle between the links, with deviations (a moving arm: '
        'docs/moving_arm.md); --report draws them')
    add('--json', action='store_true', help='print the result as JSON in the last line of stdout')
    add('--joint-states', metavar='TOPIC', default='joint_states',
        help='topic of the joint states; default: joint_states, in any namespace')
    add('--capture-event', metavar='TOPIC', action='append',
        help='topic of events; may be repeated; default: capture_event and capture_detected beside joint_states')
    looked = made.add_mutually_exclusive_group()
    looked.add_argument('--detect', action='store_true', default=None, dest='detect', help=(
        'look for captures and releases in the signals, whatever is recorded; default: where the recording has no '
        'topic of events and no time is given'))
    looked.add_argument('--no-detect', action='store_false', dest='detect', help='never look for them in the signals')
    for kind in ('capture', 'release'):
        add(f'--{kind}-time', metavar='SECONDS', type=console.seconds,
            help=f'add a {kind} at this time [s], counted from the first stamp; below 0: before the recording')
    return made


def _main(given: argparse.Namespace) -> int:
    from flexmanip_ros.io.bag import Topics, check

    if given.horizon is not None and given.validate_from is None and given.suggest is None:
        raise ParameterError('--horizon is given without --validate-from, so nothing is predicted',
                             'give --validate-from too, or leave --horizon out')
    config = load(IdentifierParameters, NODE, given.params, given.set) if given.suggest is None else None
    check(given.bag)  # what follows takes a second to import
    from flexmanip_ros.cli.replay import Request, check_places, identify, places
    from flexmanip_ros.io.outputs import check_apart
    from flexmanip_ros.studies.whole_recording import HORIZON_S

    horizon = HORIZON_S if given.horizon is None else given.horizon
    check_apart({'--suggest': given.suggest, **places(given)}, given.params, given.bag)
    topics = Topics(given.joint_states, tuple(given.capture_event or Topics().events), given.capture_event is not None)
    if config is None:
        from flexmanip_ros.cli.suggest import given_values, suggest

        check_places(given)  # the search takes a minute; ``identify`` checks them too late
        config, lines = suggest(given.bag, given.suggest, given_values(given.params, given.set), topics,
                                given.validate_from, horizon,
                                [at for at in (given.capture_time, given.release_time) if at is not None])
        print('\n'.join(lines), flush=True)
    request = Request(
        given.bag, config, topics, capture_time=given.capture_time, release_time=given.release_time,
        detect=given.detect, validate_from=given.validate_from, horizon=horizon, smooth=given.smooth,
        output=given.output, report=given.report, save_arm=given.save_arm, configurations=given.configurations)
    sys.setswitchinterval(SWITCH_S)
    with console.progress('identifying', 'messages') as progress, console.announced():
        result = identify(request, progress)
    if not given.json:
        print('\n'.join(describe(result)))
    else:
        print(json.dumps(result.summary.as_json(), allow_nan=False))
    if result.fault is not None:
        kept = ''.join(f"; what was identified is in '{place}'" for place in result.written)
        code = console.INTERRUPTED if result.interrupted else console.BAD_INPUT
        return console.print_error(PROG, '; '.join(filter(None, (f'{result.fault}{kept}', result.remark))), code)
    return console.print_error(PROG, result.remark, console.SUCCESS) if result.remark else console.SUCCESS


def describe(result: Result) -> list[str]:
    """Return the result as the lines to print."""
    from flexmanip_ros.studies.results import result_rows
    from flexmanip_ros.types import QUANTILE

    rows = result_rows(result.summary, result.config, result.modes, result.events)
    for part in result.summary.smoothed or ():
        told = ', '.join(f'{mode.frequency_hz:.4f} +- {QUANTILE * mode.frequency_std_hz:.2g} Hz' for mode in part.modes)
        last = ', in the last one' if part.course else ''
        rows.append(('smoothed', f'{part.start_s:.3f} to {part.end_s:.3f} s, {part.method}{last}: {told or "no mode"}'))
    return [f'{name:12s} {words}' for name, words in (*rows, *(('written', place) for place in result.written))]


main = partial(console.start, _parser, _main)

if __name__ == '__main__':
    sys.exit(main())
