"""Recordings made for tests."""

from __future__ import annotations

import os
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


def write(path: Path, count: int = 50, storage: StoragePlugin = StoragePlugin.MCAP,
           topic: str = '/joint_states', event_at: int | None = 20, velocity: bool = True) -> Path:
    with BagWriter(path, storage=storage) as writer:
        for k in range(count):
            made = joint_state_record(k, velocity=velocity)
            if k == event_at:
                event = CaptureEvent(made.stamp_ns, EventKind.CAPTURE)
                writer.write('/capture_event', made.stamp_ns, event)
            writer.write(topic, made.stamp_ns, made)
    return path


def storage_file(path: Path) -> Path:
    return next(file for file in path.iterdir() if file.suffix in ('.mcap', '.db3'))


def good_part(path: Path) -> tuple[list[JointRecord | CaptureEvent], str]:
    """Read until the error; return what came before and its line."""
    items: list[JointRecord | CaptureEvent] = []
    with pytest.raises(BagError) as caught:
        items.extend(bag.read(path))  # keeps what came before the error
    assert '\n' not in str(caught.value)
    return items, str(caught.value)
