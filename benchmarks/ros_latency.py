"""Claim: live at 1 kHz the payload is published at most 3 ms after its sample in 99 of 100 cases, and nothing is lost.

On an ordinary user's account, at most 20 % of a core for the identifier, and nothing lost at 4 kHz by the identifier
alone. Plant, excitation, trigger and identifier run as processes of their own over DDS; at 4 kHz samples that were
simulated beforehand are published instead. The time goes from the middleware's source time stamp of a joint state to
that of the payload with the same stamp, so the observer's own delays do not count. Use: ros_latency.py [seconds a case]
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import claims
import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import InertiaStamped
from rclpy.node import Node
from sensor_msgs.msg import JointState

from flexmanip_ros.io import cdr
from flexmanip_ros.ros import qos
from flexmanip_ros.ros.conversions import stamp_ns
from flexmanip_ros.ros.rclpy_workarounds import Batches, make_executor, with_info

HERE = Path(__file__).resolve().parent
SECONDS = 60.0
SETTLE_S = 5.0
"""Left out after the first payload: processes still start and load kernels."""
STALE_S = 5.0
"""Age of diagnostics that come once a second, beyond which the node does not keep up."""
NODES = ('rpbsid_identifier', 'capture_trigger', 'excitation', 'plant_simulator')
TICKS = os.sysconf('SC_CLK_TCK')


class Observer(Node):
    """Source time stamps of samples and payloads, and what the identifier reports."""

    def __init__(self) -> None:
        super().__init__('observer')
        self.sent: dict[int, int] = {}
        self.latencies_ns: list[int] = []
        self.lost = 0.0
        self.reported = 0.0
        """When the identifier's diagnostics came last, on the monotonic clock [s]."""
        self._samples = Batches(self, self.create_subscription(  # one by one they would cost a fifth of a core
            JointState, 'joint_states', lambda _: None, qos.sensor_input(), raw=True), lambda number: None)
        self.create_subscription(
            InertiaStamped, '/rpbsid_identifier/payload', with_info(self.on_payload), qos.latched_input())
        self.create_subscription(DiagnosticArray, '/diagnostics', self.on_report, 10)

    def on_payload(self, message: InertiaStamped, info: Any) -> None:
        """Note how long after its sample a payload was sent."""
        self.sent.update((cdr.stamp_ns(raw), about['source_timestamp']) for raw, about in self._samples.take())
        sent = self.sent.get(stamp_ns(message.header.stamp))
        if sent is not None:
            self.latencies_ns.append(info['source_timestamp'] - sent)

    def on_report(self, message: DiagnosticArray) -> None:
        """Keep the identifier's count of lost samples."""
        for status in message.status:
            if status.name == '/rpbsid_identifier: status':
                self.lost = next(float(item.value) for item in status.values if item.key == 'lost')
                self.reported = time.monotonic()


    def close(self) -> None:
        """End the node."""
        self._samples.give_back(self)
        self.destroy_node()


def cpu_seconds(pid: int) -> float:
    """Return the processor time of a process so far [s]."""
    fields = Path(f'/proc/{pid}/stat').read_text(encoding='ascii').rpartition(')')[2].split()
    return (int(fields[11]) + int(fields[12])) / TICKS


def case(commands: dict[str, list[str]], seconds: float, domain: int) -> dict[str, Any]:
    """Run processes; return latencies [ms], samples lost and processor time of the identifier."""
    os.environ.update(ROS_DOMAIN_ID=str(domain), ROS_AUTOMATIC_DISCOVERY_RANGE='LOCALHOST')
    os.environ.setdefault('ROS_LOG_DIR', str(HERE.parent / 'log' / 'ros'))
    rclpy.init()
    observer = Observer()
    executor = make_executor()
    executor.add_node(observer)

    def wait(limit_s: float, until: Callable[[], bool] = lambda: False) -> None:
        limit = time.monotonic() + limit_s
        while time.monotonic() < limit and not until():
            executor.spin_once(timeout_sec=0.05)

    processes = {name: subprocess.Popen(command) for name, command in commands.items()}
    try:
        wait(120.0, lambda: bool(observer.latencies_ns))
        wait(SETTLE_S)
        observer.latencies_ns, lost = [], observer.lost
        before, began = cpu_seconds(processes[NODES[0]].pid), time.monotonic()
        wait(seconds)
        used = (cpu_seconds(processes[NODES[0]].pid) - before) / (time.monotonic() - began)
        wait(1.5)  # for the diagnostics of the last second
        if time.monotonic() - observer.reported > STALE_S:  # a node that is so far behind does not know what it lost
            observer.lost = np.inf
        return {'latency_ms': np.array(observer.latencies_ns) * 1e-6, 'lost': observer.lost - lost,
                'cpu_percent': 100.0 * used}
    finally:
        for process in processes.values():
            process.send_signal(signal.SIGINT)
        for process in processes.values():
            try:
                process.wait(timeout=20)
            except subprocess.TimeoutExpired:  # Fast DDS, see ``rclpy_workarounds.shutdown``
                process.kill()
        executor.shutdown()
        observer.close()
        rclpy.shutdown()


def node(name: str, rate: float) -> list[str]:
    """Return the command that starts a node."""
    return [sys.executable, '-m', f'flexmanip_ros.ros.nodes.{name}', '--ros-args', '-p', f'rate:={rate}',
            '--log-level', 'error']


def measure(seconds: float = SECONDS) -> dict[str, float]:
    """Return what the claims are about, by name."""
    together = case({name: node(name, 1000.0) for name in NODES}, seconds, 1 + os.getpid() % 100)
    parts = [sys.executable, str(HERE / 'parts' / 'bare_nodes.py')]
    bare = case({NODES[0]: [*parts, 'echo', '1000'], 'plant_simulator': node('plant_simulator', 1000.0)},
                min(seconds, 20.0), 1 + (os.getpid() + 3) % 100)
    player = [*parts, 'player', '4000', str(seconds + 3 * SETTLE_S)]
    alone = case({NODES[0]: node(NODES[0], 4000.0), 'player': player}, seconds, 1 + (os.getpid() + 7) % 100)
    p50, p99 = np.percentile(together['latency_ms'], [50, 99])
    return {
        'sample to payload, median [ms]': float(p50),
        'sample to payload, 99 of 100 [ms]': float(p99),
        'samples lost at 1 kHz': float(together['lost']),
        'identifier at 1 kHz [% of a core]': float(together['cpu_percent']),
        'bare node at 1 kHz [% of a core]': float(bare['cpu_percent']),
        'samples lost at 4 kHz by the identifier alone': float(alone['lost']),
        'payloads at 4 kHz': float(alone['latency_ms'].size),
    }


def main() -> None:
    """Measure, print and write JSON."""
    seconds = float(sys.argv[1]) if len(sys.argv) > 1 else SECONDS
    values = {'seconds a case': seconds, **measure(seconds)}
    for name, value in values.items():
        print(f'{name}: {value:.4g}')
    claims.write('ros_latency', {'load_average': os.getloadavg(), **values})


if __name__ == '__main__':
    main()
