"""Recordings made for tests."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin

from flexmanip_ros.errors import BagError
from flexmanip_ros.io import bag
from flexmanip_ros.io.bag_writer import BagWriter
from flexmanip_ros.types import CaptureEvent, EventKind, JointRecord

DATA = Path(os.environ.get('FLEXMANIP_DATA', Path(__file__).parents[3] / 'shared' / 'data'))
START = 1_700_000_000_000_000_000
NAMES = ('joint1', 'joint2', 'link1_bend', 'link2_bend')
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason='measured recordings are not in ../shared/data')


def joint_state_record(k: int, *, velocity: bool = True) -> JointRecord:
    rng = np.random.default_rng(k)
    return JointRecord(START + k * 1_000_000, NAMES, rng.normal(size=4),
                       rng.normal(size=4) if velocity else np.empty(0), rng.normal(size=4))


def record(path: Path, items: Iterable[JointRecord | CaptureEvent], storage: StoragePlugin = StoragePlugin.MCAP,
           topic: str = '/joint_states') -> Path:
    """Write joint states and events as a recording, in the order in which they are given."""
    with BagWriter(path, storage=storage, flush_period=None) as writer:
        for k, item in enumerate(items):
            writer.write(topic if isinstance(item, JointRecord) else '/capture_event', START + k, item)
    return path


def write(path: Path, count: int = 50, storage: StoragePlugin = StoragePlugin.MCAP,
          topic: str = '/joint_states', event_at: int | None = 20, velocity: bool = True) -> Path:
    items: list[JointRecord | CaptureEvent] = [joint_state_record(k, velocity=velocity) for k in range(count)]
    if event_at is not None and event_at < count:
        items.insert(event_at, CaptureEvent(items[event_at].stamp_ns, EventKind.CAPTURE))
    return record(path, items, storage, topic)


def storage_file(path: Path) -> Path:
    return next(file for file in path.iterdir() if file.suffix in ('.mcap', '.db3'))


def good_part(path: Path) -> tuple[list[JointRecord | CaptureEvent], str]:
    """Read until the error; return what came before and its line."""
    items: list[JointRecord | CaptureEvent] = []
    with pytest.raises(BagError) as caught:
        items.extend(bag.read(path))  # keeps what came before the error
    assert '\n' not in str(caught.value)
    return items, str(caught.value)
