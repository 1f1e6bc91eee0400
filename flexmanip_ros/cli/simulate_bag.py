"""simulate_bag: record the simulated arm, faster than real time, with the true values in a file beside it."""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flexmanip_ros.cli import console
from flexmanip_ros.errors import BagError, ParameterError
from flexmanip_ros.io.parameter_file import load, parse_overrides
from flexmanip_ros.parameters import ExcitationParameters, PlantParameters, flatten
from flexmanip_ros.parameters.document import help_text

if TYPE_CHECKING:
    from flexmanip_ros.types import CaptureEvent

PROG = 'simulate_bag'
START_NS = 1_700_000_000_000_000_000
"""Stamp of the first sample; fixed, so that the same arguments give the same bytes."""
CAPTURE_TIME = 3.0
"""Time of the capture where none is given [s]."""
PREFIX = 'excitation.'
EXAMPLES = """examples:
  simulate_bag recording                                20 kg caught at 3 s, 6 s at 1 kHz, 40 dB
  simulate_bag recording --payload 50 --duration 10 --seed 7
  simulate_bag recording --set 'initial_angles=[0.0, 0.0]' --set excitation.shape=prbs
  simulate_bag recording --capture-time 3 --release-time 6 --duration 9 --params config/plant_simulator.yaml

Writes the recording (rosbag2, mcap) and, beside it, NAME.truth.json with the true payload and frequencies.
exit status: 0 on success; 2 on bad arguments, with one line on stderr.

parameters of the plant (in --params under plant_simulator or /**, or with --set):
"""
MORE = f'\n\nparameters of the torque (in --params under excitation, or with --set {PREFIX}NAME=VALUE):\n'


def _parser() -> console.Parser:
    made = console.parser(
        PROG, 'Simulate the flexible arm while it catches an object, into a rosbag2 recording. ROS need not run.',
        EXAMPLES + help_text(PlantParameters) + MORE + help_text(ExcitationParameters))
    add = made.add_argument
    add('bag', metavar='BAG', help='directory of the recording; it must not exist')
    add('--duration', metavar='SECONDS', type=console.seconds, default=6.0, help='simulated time [s]; default: 6')
    add('--seed', metavar='N', type=int, help='seed of the noise (parameter seed)')
    add('--payload', metavar='KG', type=float, help='mass of the object [kg] (parameter payload_mass)')
    add('--capture-time', metavar='SECONDS', type=console.seconds,
        help=f'time of the capture [s]; default: {CAPTURE_TIME:g}; negative: never')
    add('--release-time', metavar='SECONDS', type=console.seconds, default=-1.0,
        help='time of the release [s]; default: never')
    add('--expected', action='store_true',
        help='print how accurate a payload estimate from this torque can be; this takes half a minute')
    console.add_parameters(made, 'plant_simulator and excitation', f', {PREFIX}NAME for one of the torque')
    return made


def configurations(given: argparse.Namespace) -> tuple[PlantParameters, ExcitationParameters]:
    """Return the parameters: named arguments win over --set, and --set over the file."""
    from flexmanip_ros.studies.scenario import for_plant

    plant_items = [item for item in given.set if not item.startswith(PREFIX)]
    plant_items += [f'{name}={value!r}' for name, value in (
        ('seed', given.seed), ('payload_mass', given.payload)) if value is not None]
    torque_items = [item.removeprefix(PREFIX) for item in given.set if item.startswith(PREFIX)]
    plant = load(PlantParameters, 'plant_simulator', given.params, plant_items, optional=True)
    own = parse_overrides(torque_items)
    following = [f'rate={plant.rate!r}', f'arm.link_length={list(plant.arm.link_length)}']  # also against the file
    try:
        torque = load(ExcitationParameters, 'excitation', given.params, [*following, *torque_items], optional=True)
    except ParameterError as err:
        named = next((name for name in own if f"'{name}'" in err.problem), None)
        if named is None:
            raise
        raise ParameterError(err.problem.replace(f"'{named}'", f"'{PREFIX}{named}'"), err.remedy) from err
    return plant, for_plant(torque, plant, own)


def _main(given: argparse.Namespace) -> int:
    from flexmanip_ros.io.bag_writer import BagWriter
    from flexmanip_ros.io.outputs import check_place, write_text
    from flexmanip_ros.simulation import excitation, simulator
    from flexmanip_ros.studies.scenario import events_in
    from flexmanip_ros.types import CaptureEvent, JointRecord

    plant, torque = configurations(given)
    if not 0.0 < given.duration <= 1e6:
        raise ParameterError(f'--duration is {given.duration:g}', 'give seconds above 0, up to 1e6')
    count = max(round(given.duration * plant.rate), 1)
    capture = given.capture_time
    if capture is None:
        capture = CAPTURE_TIME if given.duration > CAPTURE_TIME else -1.0
    events = events_in(plant, given.duration, capture, given.release_time, START_NS, '--{}-time')
    target = Path(given.bag)
    if not target.name:
        raise BagError(f"'{given.bag}' is no name for a recording", 'give the name of a directory to make')
    truth_path = target.with_name(target.name + '.truth.json')
    if target.exists():
        raise BagError(f"'{target}' exists already", 'remove it or give another name')
    check_place(truth_path)
    with console.progress('simulating', 'samples'), console.announced():
        trajectory = simulator.simulate(plant, excitation.sequence(torque, count), events, START_NS)
    with (console.progress('writing', 'samples') as progress, BagWriter(target, flush_period=None) as writer):
        for k, item in enumerate(simulator.records(trajectory, events)):
            topic = '/joint_states' if isinstance(item, JointRecord) else '/capture_event'
            writer.write(topic, item.stamp_ns, item, latched=isinstance(item, CaptureEvent))
            if k % 1000 == 0:
                progress(k, count)
    write_text(truth_path, json.dumps(truth(plant, torque, events, count), indent=1) + '\n')
    if given.expected:
        print(excitation.describe(torque))
    empty = '' if events else ', the arm stays empty'
    print(f"wrote '{target}' ({count} samples, {given.duration:g} s{empty}) and '{truth_path}'")
    return console.SUCCESS


def truth(plant: PlantParameters, torque: ExcitationParameters, events: Sequence[CaptureEvent], count: int
          ) -> dict[str, Any]:
    """Return the true values of the run of ``count`` samples: the mass is what a soft gripper has taken by its end."""
    from flexmanip_ros.studies.trial import true_frequencies
    from flexmanip_ros.types import EventKind

    at = {event.kind: (event.stamp_ns - START_NS) * 1e-9 for event in events}
    mass, ramp = plant.payload_mass if EventKind.CAPTURE in at else 0.0, round(plant.gripper_ramp * plant.rate)
    if mass and ramp > 1:
        mass *= min(1.0, (count - round(at[EventKind.CAPTURE] * plant.rate)) / ramp)
    return {
        'payload_mass_kg': mass,
        'capture_time_s': at.get(EventKind.CAPTURE), 'release_time_s': at.get(EventKind.RELEASE),
        'working_point_deg': [math.degrees(angle) for angle in plant.initial_angles],
        'sample_time_s': 1.0 / plant.rate,
        'frequencies_before_hz': true_frequencies(plant, 0.0),
        'frequencies_after_hz': true_frequencies(plant, mass),
        'plant': flatten(plant), 'excitation': flatten(torque),
    }


main = partial(console.start, _parser, _main)

if __name__ == '__main__':
    sys.exit(main())
