"""Claim: live at 1 kHz nothing is lost, p99 from sample to estimate is 0.5 ms or less, at a fifth of a core.

Plant, excitation, trigger and identifier over DDS: composed in one process, and one process each; `apart`:
the same with all but the identifier kept to one core (`cpu_affinity`), so that the other is its own;
`ordinary`: the same where neither real-time priority nor cores that stay awake are permitted; `played`: the
identifier alone, the samples simulated beforehand; `bare`: publish and subscribe alone, the floor on the
machine as it is. Latency is from the middleware's source time stamp of a joint state to that of the estimate
with the same stamp, so that the observer's own delays do not count; `sample` is the identifier's callback for
every sample, as it reports itself; lost: of the seconds measured, and while the processes start on two cores
(all of them import and load kernels then). Use: ros_latency.py [seconds a case]
"""

from __future__ import annotations

import gc
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import InertiaStamped
from rclpy.node import Node
from sensor_msgs.msg import JointState

from flexmanip_ros.io import cdr
from flexmanip_ros.ros import affinity, qos
from flexmanip_ros.ros.conversions import stamp_ns
from flexmanip_ros.ros.node import sequence_number, with_info
from flexmanip_ros.ros.spin import Interrupt, make_executor, spin

HERE = Path(__file__).resolve().parent
SECONDS = 60.0
SETTLE_S = 3.0
CASES = (('bare', 1000.0), ('composed', 1000.0), ('separate', 1000.0), ('apart', 1000.0),
         ('ordinary', 1000.0), ('played', 4000.0), ('separate', 4000.0))
CORES = sorted(os.sched_getaffinity(0))
MORE = {'ordinary': ['-p', 'thread_priority:=0', '-p', 'wake_latency:=-1'],
        'apart': ['-p', f'cpu_affinity:=[{CORES[0]}]']}
NODES = ('rpbsid_identifier', 'capture_trigger', 'excitation', 'plant_simulator')
TICKS = os.sysconf('SC_CLK_TCK')


class Observer(Node):
    """Source time stamps of samples and estimates, losses, and what the identifier says of itself."""

    def __init__(self) -> None:
        super().__init__('observer')
        self.samples: dict[int, int] = {}
        self.latencies: list[int] = []
        self.lost = 0
        self.last: int | None = None
        self.lost_before = 0
        self.reports: list[dict[str, str]] = []
        self.create_subscription(
            JointState, 'joint_states', with_info(self.on_sample), qos.sensor_input(), raw=True)
        self.create_subscription(
            InertiaStamped, '/rpbsid_identifier/payload', with_info(self.on_estimate), qos.latched_input())
        self.create_subscription(DiagnosticArray, '/diagnostics', self.on_report, 10)

    def on_sample(self, raw: bytes, info: Any) -> None:
        """Remember when a sample was sent."""
        self.samples[cdr.stamp_ns(raw)] = info['source_timestamp']
        number = sequence_number(info)
        if self.last is not None and number is not None:
            self.lost += max(number - self.last - 1, 0)
        self.last = number

    def on_estimate(self, message: InertiaStamped, info: Any) -> None:
        """Note how long after its sample an estimate was sent."""
        sent = self.samples.get(stamp_ns(message.header.stamp))
        if sent is not None:
            self.latencies.append(info['source_timestamp'] - sent)

    def on_report(self, message: DiagnosticArray) -> None:
        """Keep the identifier's diagnostics."""
        for status in message.status:
            if status.name.startswith('rpbsid_identifier'):
                self.reports.append({item.key: item.value for item in status.values})

    def lost_so_far(self) -> int:
        """Return the samples that the identifier has missed since it heard the first one."""
        last = self.reports[-1]['lost'] if self.reports else '0'
        return int(last) if last.isdigit() else 0

    def begin(self) -> None:
        """Forget what came while things settled, but for what was lost meanwhile."""
        self.lost_before = self.lost_so_far()
        self.samples, self.latencies, self.reports, self.lost = {}, [], [], 0


def cpu_seconds(pid: int) -> float:
    """Return the processor time of a process so far."""
    fields = Path(f'/proc/{pid}/stat').read_text(encoding='ascii').rpartition(')')[2].split()
    return (int(fields[11]) + int(fields[12])) / TICKS


def parameters(rate: float) -> list[str]:
    return ['--ros-args', '-p', f'rate:={rate}', '--log-level', 'error']


def composed(rate: float) -> None:
    """Run the four nodes in this process until a signal."""
    from flexmanip_ros.ros.nodes.capture_trigger import CaptureTrigger
    from flexmanip_ros.ros.nodes.excitation import Excitation
    from flexmanip_ros.ros.nodes.plant_simulator import PlantSimulator
    from flexmanip_ros.ros.nodes.rpbsid_identifier import RpbsidIdentifier

    interrupt = Interrupt()
    rclpy.init(args=['composed', *parameters(rate)])
    nodes = [RpbsidIdentifier(), CaptureTrigger(), Excitation(), PlantSimulator()]
    executor = make_executor()
    interrupt.install()
    for node in nodes:
        executor.add_node(node)
        node.autostart()
    nodes[0].real_time.take()
    gc.collect()
    gc.freeze()
    spin(executor, None, interrupt)
    executor.shutdown()


def case(name: str, rate: float, seconds: float, domain: int) -> dict[str, Any]:
    """Measure one arrangement."""
    os.environ.update(ROS_DOMAIN_ID=str(domain), ROS_AUTOMATIC_DISCOVERY_RANGE='LOCALHOST')
    os.environ.setdefault('ROS_LOG_DIR', str(HERE.parent / 'log' / 'ros'))
    rclpy.init()
    observer = Observer()
    executor = make_executor()
    executor.add_node(observer)
    if name == 'composed':
        commands = {'all': [sys.executable, __file__, '--composed', str(rate)]}
    elif name == 'bare':
        commands = {node: [sys.executable, str(HERE / 'parts' / 'bare_nodes.py'), role, str(rate)]
                    for node, role in (('source', 'source'), ('rpbsid_identifier', 'echo'))}
    else:
        nodes = NODES[:1] if name == 'played' else NODES
        spared = NODES[:1] if name == 'apart' else ()
        commands = {node: [sys.executable, '-m', f'flexmanip_ros.ros.{node}', *parameters(rate),
                           *(() if node in spared else MORE.get(name, ()))] for node in nodes}
    if name == 'played':
        commands['player'] = [sys.executable, str(HERE / 'parts' / 'bare_nodes.py'), 'player', str(rate),
                              str(seconds + 2 * SETTLE_S)]
    processes = {node: subprocess.Popen(command) for node, command in commands.items()}
    affinity.take(CORES[:1] if name == 'apart' else [])
    try:
        wait(executor, lambda: bool(observer.latencies), 120.0)
        wait(executor, lambda: False, SETTLE_S)
        observer.begin()
        before = {node: cpu_seconds(process.pid) for node, process in processes.items()}
        began = time.monotonic()
        wait(executor, lambda: False, seconds)
        wall = time.monotonic() - began
        used = {node: 100.0 * (cpu_seconds(process.pid) - before[node]) / wall
                for node, process in processes.items()}
        count, latencies = len(observer.samples), np.array(observer.latencies) * 1e-3
        reports, lost = observer.reports, observer.lost
        missed = observer.lost_so_far() - observer.lost_before if reports else 0, observer.lost_before
    finally:
        for process in processes.values():
            process.send_signal(signal.SIGINT)
        for process in processes.values():
            try:
                process.wait(timeout=20)
            except subprocess.TimeoutExpired:  # Fast DDS, see ``spin.time_limit``
                process.kill()
        executor.shutdown()
        observer.destroy_node()
        rclpy.shutdown()
        affinity.take(CORES)
    p50, p99 = np.percentile(latencies, [50, 99]) if latencies.size else (np.nan, np.nan)
    sample = [[float(r[f'callback_{what}_us']) for r in reports] or [0.0] for what in ('p50', 'p99', 'max')]
    return {
        'arrangement': name, 'rate_hz': rate, 'samples_hz': count / wall, 'seconds': wall,
        'lost_by_identifier': missed[0], 'lost_while_starting': missed[1], 'lost_by_observer': lost,
        'estimates': int(latencies.size),
        'estimate_us': [float(p50), float(p99), float(latencies.max(initial=0.0))],
        'sample_us': [float(np.median(sample[0])), float(np.median(sample[1])), max(sample[2])],
        'cpu_percent': used,
    }


def wait(executor: Any, condition: Any, seconds: float) -> None:
    limit = time.monotonic() + seconds
    while time.monotonic() < limit and not condition():
        executor.spin_once(timeout_sec=0.05)


def main() -> int:
    """Measure every arrangement; print a table and write JSON."""
    if len(sys.argv) == 3 and sys.argv[1] == '--composed':
        composed(float(sys.argv[2]))
        return 0
    seconds = float(sys.argv[1]) if len(sys.argv) > 1 else SECONDS
    rows = [case(name, rate, seconds, 1 + (os.getpid() + 7 * k) % 100)
            for k, (name, rate) in enumerate(CASES)]
    print('| arrangement | rate Hz | held Hz | lost (while starting) | estimate p50 / p99 / max us | '
          'sample p50 / p99 / max us | CPU % |')
    print('|---|---|---|---|---|---|---|')
    for row in rows:
        print(f'| {row["arrangement"]} | {row["rate_hz"]:.0f} | {row["samples_hz"]:.0f} | '
              f'{row["lost_by_identifier"]} ({row["lost_while_starting"]}) | '
              + ' / '.join(f'{value:.0f}' for value in row['estimate_us']) + ' | '
              + ' / '.join(f'{value:.0f}' for value in row['sample_us']) + ' | '
              + ', '.join(f'{node} {value:.0f}' for node, value in row['cpu_percent'].items()) + ' |')
    target = HERE / 'results' / 'ros_latency.json'
    target.parent.mkdir(exist_ok=True)
    text = json.dumps({'load_average': os.getloadavg(), 'cases': rows}, indent=1) + '\n'
    target.write_text(text, encoding='utf-8')
    return 0


if __name__ == '__main__':
    sys.exit(main())
