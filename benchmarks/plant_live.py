"""The plant node keeps 1 kHz for 60 s with no stamp lost, its ticks as regular as a bare timer's.

Node and listener in two processes on the default quality of service; stamps are checked one by one.
Tick-to-tick intervals are taken where the node publishes, and beside them those of an empty timer of the
same rate in a process of its own before it.

Use: python benchmarks/plant_live.py [--seconds N]
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import time
from typing import Any

import claims
import numpy as np

RATE = 1000.0
DOMAIN = 77


def plant(seconds: float, bare: bool, results: Any) -> None:
    """Run the node (or a bare timer) and hand back the instants of its ticks [s]."""
    import rclpy
    from rclpy.context import Context
    from rclpy.parameter import Parameter

    from flexmanip_ros.ros.nodes.plant_simulator import PlantSimulator
    from flexmanip_ros.ros.rclpy_workarounds import make_executor

    context = Context()
    rclpy.init(context=context, domain_id=DOMAIN)
    executor = make_executor(context)
    ticks: list[float] = []
    if bare:
        node = rclpy.create_node('bare', context=context)
        node.create_timer(1.0 / RATE, lambda: ticks.append(time.perf_counter()))
    else:
        node = PlantSimulator(context=context, overrides=[Parameter('rate', value=RATE)])
        node.trigger_configure()
        publish = node.joint_states.publish

        def timed(message: Any) -> None:
            publish(message)
            ticks.append(time.perf_counter())

        node.joint_states.publish = timed
        limit = time.monotonic() + 20.0
        while node.joint_states.get_subscription_count() == 0 and time.monotonic() < limit:
            time.sleep(0.01)
        node.trigger_activate()
    executor.add_node(node)
    busy = time.process_time()
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        executor.spin_once(timeout_sec=0.1)
    busy = time.process_time() - busy
    executor.remove_node(node)
    results.put((np.array(ticks), busy / seconds))
    node.destroy_node()
    context.try_shutdown()


def listener(seconds: float, results: Any) -> None:
    """Collect the stamps [ns] that arrive."""
    import rclpy
    from rclpy.context import Context
    from sensor_msgs.msg import JointState

    from flexmanip_ros.ros import qos
    from flexmanip_ros.ros.conversions import stamp_ns
    from flexmanip_ros.ros.rclpy_workarounds import make_executor

    context = Context()
    rclpy.init(context=context, domain_id=DOMAIN)
    executor = make_executor(context)
    node = rclpy.create_node('listener', context=context)
    stamps: list[int] = []
    node.create_subscription(
        JointState, 'joint_states', lambda message: stamps.append(stamp_ns(message.header.stamp)),
        qos.sensor_output())
    executor.add_node(node)
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        executor.spin_once(timeout_sec=0.1)
    executor.remove_node(node)
    results.put(np.array(stamps))
    node.destroy_node()
    context.try_shutdown()


def jitter(ticks: np.ndarray) -> dict[str, float]:
    """Percentiles of the distance of tick-to-tick intervals from the period [us]."""
    off = np.abs(np.diff(ticks) - 1.0 / RATE) * 1e6
    return {name: float(np.percentile(off, p)) for name, p in (('p50', 50), ('p99', 99), ('p99.9', 99.9))}


def main() -> None:
    """Measure, print and write the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--seconds', type=float, default=60.0)
    seconds = parser.parse_args().seconds
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
    spawn = multiprocessing.get_context('spawn')
    queue, heard = spawn.Queue(), spawn.Queue()
    bare = spawn.Process(target=plant, args=(seconds, True, queue))
    bare.start()
    bare_ticks, bare_share = queue.get()
    bare.join()
    ear = spawn.Process(target=listener, args=(seconds + 25.0, heard))
    ear.start()
    node = spawn.Process(target=plant, args=(seconds, False, queue))
    node.start()
    ticks, share = queue.get()
    stamps = heard.get()
    node.join()
    ear.join()
    steps = np.diff(stamps)
    lost = round((stamps[-1] - stamps[0]) * RATE * 1e-9) + 1 - len(stamps)
    results = {
        'seconds': seconds, 'published': len(ticks), 'arrived': len(stamps), 'stamps_lost_between': lost,
        'stamps_out_of_order': int(np.sum(steps <= 0)), 'jitter_us': jitter(ticks),
        'jitter_bare_timer_us': jitter(bare_ticks), 'share_of_a_core': share,
        'share_of_a_core_bare_timer': bare_share}
    for name, value in results.items():
        print(f'{name}: {value}')
    claims.write('plant_live', results)


if __name__ == '__main__':
    main()
