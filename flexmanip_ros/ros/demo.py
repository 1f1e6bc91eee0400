"""Program ``demo``: the arm catches something, live, and is recorded, drawn and replayed.

Plant, excitation, capture trigger and identifier run as ROS nodes over DDS against the wall clock. A new
folder below OUTPUT gets the bag (mcap) and the picture; replaying that bag must give the live numbers bit for
bit.
"""

import argparse
import json
import os
import select
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Any, NamedTuple
from urllib.request import urlopen

import numpy as np
import rclpy
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args
from rich.console import Console
from rich.table import Table
from std_msgs.msg import Float64MultiArray

from flexmanip_ros import messages, pipeline
from flexmanip_ros.arm.linearization import bending_frequencies
from flexmanip_ros.cli.console import BAD_INPUT, INTERRUPTED, Parser, print_error
from flexmanip_ros.errors import FlexmanipError, ParameterError
from flexmanip_ros.io import bag, plots
from flexmanip_ros.io.plots import Truth
from flexmanip_ros.parameters import DemoParameters, PlantParameters, configure, flatten, leaves
from flexmanip_ros.parameters.arm import settings
from flexmanip_ros.parameters.document import NODES, written, yaml_text
from flexmanip_ros.ros import rclpy_workarounds
from flexmanip_ros.ros.composition import Composition, foreign_arm
from flexmanip_ros.ros.conversions import to_message
from flexmanip_ros.samples import sampling
from flexmanip_ros.studies.results import status_text
from flexmanip_ros.types import QUANTILE, CaptureEvent, Estimate, JointRecord

END_TIMEOUT_S = 15.0


class Viewer(NamedTuple):
    """The process of the node ``live_view`` and the address of its page."""

    process: subprocess.Popen[bytes]
    url: str

    def pages(self) -> int:
        """Return how many pages are open."""
        try:
            with urlopen(self.url + 'state', timeout=1.0) as answer:
                return int(json.load(answer)['pages'])
        except OSError:
            return 0


@contextmanager
def viewer(arguments: Sequence[str]) -> Iterator[Viewer]:
    """Start ``live_view`` on the domain of this process with its ROS arguments; end it when the context is left.

    Raises FlexmanipError when the node does not start, for example on a port that is in use; the node has logged why.
    """
    domain = rclpy.get_default_context().get_domain_id()
    # The node has a session of its own: Ctrl-C at the terminal reaches the demonstration alone, which then ends it.
    process = subprocess.Popen(
        [sys.executable, '-m', 'flexmanip_ros.ros.nodes.live_view', *ros_arguments(arguments)],
        env={**os.environ, 'ROS_DOMAIN_ID': str(domain)}, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
        start_new_session=True)
    try:
        yield Viewer(process, _url(process))
    finally:
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
        try:
            process.wait(END_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def ros_arguments(arguments: Sequence[str]) -> list[str]:
    """Return --ros-args and the arguments that follow it up to --."""
    kept, inside = ['--ros-args'], False
    for item in arguments:
        if item == '--ros-args' or (inside and item == '--'):
            inside = item == '--ros-args'
        elif inside:
            kept.append(item)
    return kept


def _url(process: subprocess.Popen[bytes]) -> str:
    """Return the address of the page, which the node prints on stdout."""
    assert process.stdout is not None
    ready, _, _ = select.select([process.stdout], [], [], PAGE_TIMEOUT_S)
    line = process.stdout.readline() if ready else b''
    for word in line.decode().split():
        if word.startswith('http://'):
            return word
    raise FlexmanipError('the live view did not start', 'see its log above, or leave --view away')


NAME = 'demo'
PAGE_TIMEOUT_S = 20.0
LOOK_AROUND_S = 0.5
"""Time for which the program looks for another arm on a domain [s]."""
LATEST_NS = 500_000_000
"""Time over which the joint angles are averaged [ns]; the true frequencies are those at the mean angles."""
FAILED = 1
"""Exit code if it could not run, or live and replay differ."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the demonstration; return 0, ``FAILED``, ``INTERRUPTED``, or 2 for bad input."""
    arguments = list(sys.argv if argv is None else argv)
    rclpy_workarounds.interrupt_on_signals()
    console = Console(highlight=False, soft_wrap=True)
    # A demonstration must never reach a robot on the network.
    os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    try:
        options = parser().parse_args(remove_ros_args(arguments)[1:])
        config = configure(DemoParameters, {
            leaf.name: getattr(options, leaf.name) for leaf in leaves(DemoParameters)})
        folder = new_folder(Path(options.output))
        given = [arguments[0], *node_arguments(config), *arguments[1:]]
        _init(given, console)
    except KeyboardInterrupt:
        return INTERRUPTED
    except OSError as error:
        return print_error(NAME, f"'{options.output}' cannot be written: {error.strerror}; give another folder")
    except Exception as error:  # rcl raises types of its C extension for --ros-args and parameter files
        return print_error(NAME, rclpy_workarounds.first_line(error))
    try:
        with viewer(given) if config.view else nullcontext() as view:
            return _run(config, folder, console, view)
    except KeyboardInterrupt:
        console.print('interrupted' + (f"; the bag so far is '{folder / 'bag'}'" if (folder / 'bag').exists() else ''))
        return INTERRUPTED
    except OSError as error:  # a full disk
        return print_error(NAME, f"{error.strerror or error}; what was written before is in '{folder}'", FAILED)
    except FlexmanipError as error:
        return print_error(NAME, error, BAD_INPUT if isinstance(error, ParameterError) else FAILED)


def _run(config: DemoParameters, folder: Path, console: Console, view: Viewer | None) -> int:
    console.print('Starting the nodes (the first time, kernels are compiled)')
    began = time.monotonic()
    composition: Composition | None = None
    try:
        composition = Composition(config, folder / 'bag')
        rclpy_workarounds.interrupt_on_signals()
        composition.configure()
        composition.connect(others=0 if view is None else 1)
        console.print(f'Ready after {time.monotonic() - began:.1f} s: plant_simulator, excitation, capture_trigger, '
                      f'rpbsid_identifier over {rclpy.utilities.get_rmw_implementation_identifier()}')
        if view is not None:
            console.print(f'\nlive view: open {view.url} in a browser on this machine')
            _wait_for_a_page(view, composition, console)
        began = time.monotonic()
        composition.run(console.print)
        composition.drain()
        failure, live = composition.recorder.failure, composition.recorder.published
        identifier, plant = composition.identifier.config, composition.plant.config
        console.print(f'\n{composition.recorder.joint_states} samples in {time.monotonic() - began:.2f} s, '
                      f'{composition.lost} lost')
    finally:
        with rclpy_workarounds.shutdown():
            if composition is not None:
                composition.close()
            composition = None
    rclpy_workarounds.interrupt_on_signals()
    if failure is not None:
        console.print(f"recording: {failure}\nbag      {folder / 'bag'}")
        return FAILED
    items = list(bag.read(folder / 'bag'))
    began = time.monotonic()
    estimates = list(pipeline.run(identifier, items))
    different = compare(live, outgoing(estimates, identifier.payload_frame))
    replay_s = time.monotonic() - began
    truth = known_truth(config, plant, items)
    # The picture shows the two lowest modes, which a payload changes. On an axis that reaches to the next mode, at
    # 50 Hz, these two look like one line.
    shown = [estimate._replace(modes=estimate.modes[:len(truth.before)]) for estimate in estimates]
    events = [item for item in items if isinstance(item, CaptureEvent)]
    plots.overview_figure(plots.run(identifier, sampling.collect(identifier, items), shown, events, truth),
                          folder / 'overview.png', _title(config))
    console.print(_table(config, estimates, items, truth))
    console.print(f'replay: {different}' if different else
                  f'replay of the bag ({replay_s:.1f} s): all {sum(map(len, live.values()))} live messages of the '
                  'identifier, bit for bit')
    (folder / 'identifier.yaml').write_text(
        yaml_text('rpbsid_identifier', flatten(identifier), 'The identifier as it ran in this demonstration.'),
        encoding='utf-8')
    console.print(f"\nbag      {folder / 'bag'}\npicture  {folder / 'overview.png'}\n"
                  f"again    {beside('identify_bag')} {folder / 'bag'} --params {folder / 'identifier.yaml'}")
    if view is not None and sys.stdout.isatty():
        console.print(f'\nthe live view stays open at {view.url} until Ctrl-C')
        with suppress(KeyboardInterrupt):
            view.process.wait()
    return FAILED if different else 0


def beside(program: str) -> str:
    """Return how to call another program of this package: by its name, or by its path where that is not on PATH."""
    path = Path(sys.argv[0]).with_name(program)
    return str(path) if shutil.which(program) is None and path.is_file() else program


def _wait_for_a_page(view: Viewer, composition: Composition, console: Console) -> None:
    """If the program runs on a terminal, wait until a person opens the page, at most ``PAGE_TIMEOUT_S``."""
    if sys.stdout.isatty():
        console.print(f'the run starts when the page is open, at the latest after {PAGE_TIMEOUT_S:.0f} s')
        composition.wait(lambda: view.pages() > 0, PAGE_TIMEOUT_S)


def parser() -> Parser:
    """Return the arguments: an output folder and every parameter of the demonstration."""
    made = Parser(
        prog=NAME, description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog='parameters of the nodes: demo --ros-args -p rpbsid_identifier:order:=4')
    made.add_argument('output', nargs='?', default='demo_output',
                      help='folder that gets a new numbered folder for this run (default: %(default)s)')
    for leaf in leaves(DemoParameters):
        unit = f' [{leaf.unit}]' if leaf.unit else ''
        name = '--' + leaf.name.replace('_', '-')
        if leaf.kind is bool:
            made.add_argument(name, action='store_true', help=leaf.words)
            continue
        made.add_argument(name, type=leaf.kind, default=leaf.default, metavar=leaf.name.upper(),
                          help=f'{leaf.words}{unit} (default: %(default)s)')
    return made


def node_arguments(config: DemoParameters) -> list[str]:
    """Return the nodes' parameters as ROS arguments; the user's own arguments follow and override them."""
    given = ['--ros-args']
    for node, values in settings(config).items():
        for leaf in leaves(NODES[node]):
            if leaf.name in values:
                given += ['-p', f'{node}:{leaf.name}:={written(leaf, values[leaf.name])}']
    return [*given, '--']


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
    """Initialize rclpy on a domain without another arm: the user's own, or else a free one."""
    domain: int | None = None
    for attempt in range(10):
        rclpy.init(args=list(arguments), signal_handler_options=SignalHandlerOptions.NO, domain_id=domain)
        if not _occupied():
            if domain is not None:
                console.print(f'another arm is on the usual domain; this one is on ROS_DOMAIN_ID={domain}')
            return
        rclpy.shutdown()
        domain = (os.getpid() + attempt) % 100 + 1
    raise ParameterError('no free ROS domain was found', 'set ROS_DOMAIN_ID')


def _occupied() -> bool:
    """Return whether another process uses the topics of joint states or efforts on the domain."""
    node = Node('demo_lookout')
    limit = time.monotonic() + LOOK_AROUND_S
    while not (found := foreign_arm(node, own_writers=0, own_readers=0)) and time.monotonic() < limit:
        time.sleep(0.05)
    node.destroy_node()
    return found


def outgoing(estimates: Iterable[Estimate], frame_id: str) -> dict[str, list[Any]]:
    """Return the messages that are published for estimates, by topic, in order."""
    published: dict[str, list[Any]] = {}
    for estimate in estimates:
        for name, value in messages.outgoing(estimate, frame_id):
            published.setdefault(name, []).append(to_message(value))
    return published


def compare(live: Mapping[str, Sequence[Any]], replayed: Mapping[str, Sequence[Any]]) -> str:
    """Return a sentence on the first difference in any bit between two sets of messages; empty when they are equal."""
    for name in sorted({*live, *replayed}):
        ours, theirs = live.get(name, ()), replayed.get(name, ())
        if len(ours) != len(theirs):
            return f'~/{name} has {len(ours)} messages live and {len(theirs)} replayed'
        for k, (one, other) in enumerate(zip(ours, theirs, strict=True)):
            if _bits(one) != _bits(other):
                return f'message {k} of ~/{name} differs between live and replay'
    return ''


def _bits(message: Any) -> bytes:
    """Return a message as bytes; two messages give equal bytes only when every bit is equal."""
    if isinstance(message, Float64MultiArray):
        return repr(message.layout).encode() + bytes(message.data)
    return repr(message).encode()


def known_truth(config: DemoParameters, plant: PlantParameters, items: Sequence[JointRecord | CaptureEvent]) -> Truth:
    """Return the true values of the simulation: the payload mass and the frequencies of the arm.

    The frequencies vary with the joint angles. They are computed at the mean angles of the last half second before the
    capture and of the last half second of the run, because the table shows the last estimates at these two times.
    """
    records = [item for item in items if isinstance(item, JointRecord)]
    first_ns, end_ns = records[0].stamp_ns, records[-1].stamp_ns
    caught_ns = min((item.stamp_ns for item in items if isinstance(item, CaptureEvent)), default=end_ns)

    def lowest(mass: float, from_ns: int, until_ns: int) -> tuple[float, ...]:
        angles = [np.cumsum(record.position[:2]) for record in records
                  if max(from_ns, until_ns - LATEST_NS) <= record.stamp_ns <= until_ns]
        found = bending_frequencies(plant.arm, np.mean(angles, axis=0), mass, locked=plant.locked)
        return tuple(float(f) for f in found[:2])

    return Truth(config.payload_mass if config.capture_time >= 0.0 else None, lowest(0.0, first_ns, caught_ns),
                 lowest(config.payload_mass, min(caught_ns, end_ns), end_ns))


def _title(config: DemoParameters) -> str:
    if config.capture_time < 0.0:
        return 'Two flexible links, identified live'
    return f'Two flexible links catch {config.payload_mass:g} kg after {config.capture_time:g} s, identified live'


def _table(config: DemoParameters, estimates: Sequence[Estimate], items: Sequence[JointRecord | CaptureEvent],
           truth: Truth) -> Table:
    """Return a table of the estimates beside the true values, before and after the capture."""
    table = Table('', 'estimate', '95 % interval', 'true')
    capture_ns = min((item.stamp_ns for item in items if isinstance(item, CaptureEvent)), default=None)
    before = [e for e in estimates if e.modes and (capture_ns is None or e.stamp_ns < capture_ns)]
    after = [e for e in estimates if e.modes and capture_ns is not None and e.stamp_ns >= capture_ns]
    for words, found, known in (('before', before, truth.before), ('after', after, truth.after)):
        for k, mode in enumerate(found[-1].modes[:len(known)] if found else ()):
            band = QUANTILE * mode.frequency_std_hz
            low, high = mode.frequency_hz - band, mode.frequency_hz + band
            table.add_row(f'frequency {k + 1} {words} [Hz]', f'{mode.frequency_hz:.3f}',
                          f'{low:.3f} .. {high:.3f}' if np.isfinite(band) else '-', f'{known[k]:.3f}')
    held = [e.payload for e in estimates if e.payload is not None]
    if held and truth.payload is not None:
        last, true = held[-1], 0.0 if config.release_time >= 0.0 else truth.payload
        known = np.isfinite(last.upper)
        table.add_row('payload \\[kg]', f'{last.mass:.3f}' if known else 'not known',
                      f'{last.lower:.3f} .. {last.upper:.3f}' if known else '-', f'{true:.3f}')
        table.add_row('residual power / noise', f'{last.consistency:.2f}', '', '1')
        table.add_row('status', status_text(last.status), '', '')
    return table


if __name__ == '__main__':
    sys.exit(main())
