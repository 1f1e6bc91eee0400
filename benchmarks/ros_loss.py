"""Claim: 1 and 5 % of loss, bursts of 10 to 100 ms a second, 100 ms of jitter: TRACKING in 95 % of the estimates.

From 1 s after the capture of 20 kg on, live (plant, relay and identifier are processes over DDS; the relay loses or
holds back joint states) and replayed (the same faults in simulated runs). Each is the mean of ten runs: whether a burst
hides a step of the torque is chance, and a run's estimates depend on one another. Use: ros_loss.py [runs]
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import claims
import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from parts.lossy_relay import CASES, Losses
from rclpy.node import Node
from std_msgs.msg import Header

from flexmanip_ros import messages, pipeline
from flexmanip_ros.parameters import ExcitationParameters, IdentifierParameters, PlantParameters, configure
from flexmanip_ros.ros import qos
from flexmanip_ros.ros.conversions import stamp_ns
from flexmanip_ros.ros.rclpy_workarounds import make_executor
from flexmanip_ros.simulation import excitation, simulator
from flexmanip_ros.types import CaptureEvent, EventKind, JointRecord

HERE = Path(__file__).resolve().parent
CAPTURE_S, SETTLED_S, END_S, PAYLOAD = 3.0, 1.0, 8.0, 20.0
START_S = 60.0
"""Longest time in which all nodes have started and the capture has come."""


class Said(NamedTuple):
    """What was published of a payload or a model: its name, stamp and values."""

    name: str
    stamp_ns: int
    values: dict[str, str]


class Observer(Node):
    """Keeps every status of the identifier, and the instant of the capture."""

    def __init__(self) -> None:
        super().__init__('observer')
        self.said: list[Said] = []
        self.capture_ns = 0
        profile = qos.latched_input()
        profile.depth = 1000
        self.create_subscription(DiagnosticArray, '/rpbsid_identifier/status', self.on_status, profile)
        self.create_subscription(Header, '/capture_event', self.on_event, qos.latched_input())

    def on_status(self, message: DiagnosticArray) -> None:
        """Keep one entry."""
        (entry,) = message.status
        self.said.append(Said(entry.name, stamp_ns(message.header.stamp),
                              {item.key: item.value for item in entry.values}))

    def on_event(self, message: Header) -> None:
        """Keep when the object was caught."""
        self.capture_ns = stamp_ns(message.stamp)

    @property
    def done(self) -> bool:
        """Whether the run has come to its end."""
        return bool(self.capture_ns and self.said
                    and self.said[-1].stamp_ns > self.capture_ns + (END_S - CAPTURE_S) * 1e9)


def node(name: str, *arguments: str) -> list[str]:
    """Return the command that starts a node."""
    return [sys.executable, '-m', f'flexmanip_ros.ros.nodes.{name}', '--ros-args', '--log-level', 'error', *arguments]


def live(case: str, seed: int) -> tuple[list[Said], int]:
    """Run the nodes with the relay between; return what the identifier said, and the instant of the capture."""
    os.environ.setdefault('ROS_LOG_DIR', str(HERE.parent / 'log' / 'ros'))
    os.environ.update(ROS_AUTOMATIC_DISCOVERY_RANGE='LOCALHOST')
    os.environ.setdefault('ROS_DOMAIN_ID', str(1 + os.getpid() % 100))
    before = ('-r', 'joint_states:=sent/joint_states')
    commands = [
        node('rpbsid_identifier'), [sys.executable, str(HERE / 'parts' / 'lossy_relay.py'), case, str(seed)],
        node('capture_trigger', *before, '-p', 'mode:=time', '-p', f'capture_time:={CAPTURE_S}'),
        node('excitation', *before, '-p', 'clock:=joint_states'),
        node('plant_simulator', *before, '-p', f'payload_mass:={PAYLOAD}', '-p', f'seed:={seed}')]
    rclpy.init()
    observer = Observer()
    executor = make_executor()
    executor.add_node(observer)
    processes = []
    try:
        for command in commands[:-1]:
            processes.append(subprocess.Popen(command))
        limit = time.monotonic() + START_S
        while time.monotonic() < limit and observer.count_subscribers('/sent/joint_states') < 3:
            executor.spin_once(timeout_sec=0.05)
        processes.append(subprocess.Popen(commands[-1]))  # the plant last: every reader is there
        while time.monotonic() < limit and not observer.done:
            executor.spin_once(timeout_sec=0.05)
        return list(observer.said), observer.capture_ns
    finally:
        for process in processes:
            process.send_signal(signal.SIGINT)
        for process in processes:
            try:
                process.wait(timeout=20)
            except subprocess.TimeoutExpired:  # Fast DDS, see ``rclpy_workarounds.shutdown``
                process.kill()
        executor.shutdown()
        observer.destroy_node()
        rclpy.shutdown()


def replayed(case: str, seed: int) -> list[Said]:
    """Return what the identifier says of a simulated run with the same faults; jitter changes no stamp."""
    plant = configure(PlantParameters, {'seed': seed, 'payload_mass': PAYLOAD})
    events = (CaptureEvent(round(CAPTURE_S * 1e9), EventKind.CAPTURE),)
    run = simulator.simulate(plant, excitation.sequence(ExcitationParameters(), round(END_S * plant.rate)), events)
    losses = Losses(case, seed)
    items = [item for item in simulator.records(run, events)
             if not (isinstance(item, JointRecord) and losses.takes(item.stamp_ns))]
    said = []
    for estimate in pipeline.run(IdentifierParameters(), items):
        for name, value in messages.outgoing(estimate, 'tip'):
            if name == messages.STATUS:
                assert isinstance(value, messages.Diagnostics)
                (entry,) = value.statuses
                said.append(Said(entry.name, value.stamp_ns, dict(entry.values)))
    return said


def figures(said: Iterable[Said], capture_ns: int) -> dict[str, float]:
    """Return shares that are TRACKING, median deviations of these, and the payloads whose interval holds the truth."""
    late = [one for one in said if one.stamp_ns >= capture_ns + SETTLED_S * 1e9]
    found: dict[str, float] = {}
    for name, keys in (('payload', ('std_kg',)), ('model', ('frequency_std_hz_1', 'frequency_std_hz_2'))):
        every = [one.values for one in late if one.name == name]
        trusted = [values for values in every if values['status'] == 'TRACKING']
        found[f'{name}: readings'] = len(every)
        found[f'{name}: tracking'] = len(trusted) / max(len(every), 1)
        for key in keys:
            widths = [float(values[key]) for values in trusted if key in values]
            found[f'{name}: {key}'] = float(np.median(widths)) if widths else float('nan')
    masses = [one.values for one in late if one.name == 'payload' and one.values['status'] == 'TRACKING']
    inside = [float(values['lower95_kg']) <= PAYLOAD <= float(values['upper95_kg']) for values in masses]
    found['payload: inside'] = float(np.mean(inside)) if inside else float('nan')
    return found


def mean(runs: Sequence[dict[str, float]]) -> dict[str, float]:
    """Return the mean of each figure."""
    return {name: float(np.mean([run[name] for run in runs])) for name in runs[0]}


def main() -> None:
    """Measure, print and write JSON."""
    seeds = range(1, 1 + (int(sys.argv[1]) if len(sys.argv) > 1 else 10))
    rows: list[dict[str, Any]] = []
    for case in CASES:
        rows.append({'case': case, 'how': 'live', 'runs': len(seeds),
                     **mean([figures(*live(case, seed)) for seed in seeds])})
        if case == 'jitter':  # when a message arrives enters no number of a replay
            continue
        rows.append({'case': case, 'how': 'replayed', 'runs': len(seeds),
                     **mean([figures(replayed(case, seed), round(CAPTURE_S * 1e9)) for seed in seeds])})
    for row in rows:
        print('  '.join(f'{name} {value:.4g}' if isinstance(value, float) else str(value)
                        for name, value in row.items()))
    claims.write('ros_loss', rows)


if __name__ == '__main__':
    main()
