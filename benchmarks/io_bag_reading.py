"""Claim: reading a recording costs less than the identifier spends on its samples.

The same JointState messages decoded by the library, one by one and in blocks by ours, a whole recording read and
written, and the identifier's update on as many samples: microseconds a message, ratios within this one run.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import claims
import numpy as np
from identification_speed import identifier
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore

from flexmanip_ros.io import bag, cdr
from flexmanip_ros.io.bag_writer import BagWriter
from flexmanip_ros.types import JointRecord

MESSAGES = 50_000
REPEATS = 5
JOINT_STATE = 'sensor_msgs/msg/JointState'
NAMES = ('joint1', 'joint2', 'link1_bend', 'link2_bend')


def best(work: Callable[[], object]) -> float:
    """Return the shortest time of a few repeats, in microseconds a message."""
    times = []
    for _ in range(REPEATS):
        started = time.perf_counter()
        work()
        times.append(time.perf_counter() - started)
    return 1e6 * min(times) / MESSAGES


def main() -> None:
    store = get_typestore(Stores.ROS2_JAZZY)
    rng = np.random.default_rng(1)
    records = [JointRecord(k * 1_000_000, NAMES, *rng.normal(size=(3, 4))) for k in range(MESSAGES)]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / 'bag'
        started = time.perf_counter()
        with BagWriter(path) as writer:
            for record in records:
                writer.write('/joint_states', record.stamp_ns, record)
        writing = 1e6 * (time.perf_counter() - started) / MESSAGES
        with Reader(path) as reader:
            raws = [bytes(raw) for _, _, raw in reader.messages()]

        def by_library() -> None:
            for raw in raws:
                message = store.deserialize_cdr(raw, JOINT_STATE)
                stamp = message.header.stamp
                JointRecord(stamp.sec * 10**9 + stamp.nanosec, tuple(message.name), message.position,
                            message.velocity, message.effort)

        def by_layout() -> None:
            decoder = cdr.Decoder()
            for raw in raws:
                decoder.record(raw)

        def in_blocks() -> None:
            for _ in cdr.Decoder().blocks(raws):
                pass

        rows = {
            'decode, library': best(by_library),
            'decode one by one': best(by_layout),
            'decode in blocks': best(in_blocks),
            'read a recording': best(lambda: sum(1 for _ in bag.read(path))),
            'read a recording in blocks': best(lambda: sum(1 for _ in bag.read_blocks(path))),
            'write a recording': writing,
            'identifier, update': identifier(10, 2, 4, 20_000),
        }
    for name, value in rows.items():
        print(f'{name:28s} {value:8.2f} us a message')
    claims.write('io_bag_reading', {'us_per_message': rows})


if __name__ == '__main__':
    main()
