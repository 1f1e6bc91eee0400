"""Write plain values to a rosbag2 recording (mcap). A killed process loses a fraction of a second of it at most."""

from __future__ import annotations

import contextlib
import time
from pathlib import Path

import numpy as np
from rosbags.interfaces import Connection, Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.rosbag2.errors import WriterError
from rosbags.rosbag2.storage_mcap import McapWriter
from rosbags.typesys import Stores, get_typestore

from flexmanip_ros.errors import BagError
from flexmanip_ros.io.bag import STORAGE, DamagedError, salvaged
from flexmanip_ros.messages import AnyValue, message

FLUSH_PERIOD = 0.2
"""Time between two flushes [s]. The library itself flushes after one mebibyte, which is 4 s at 1 kHz."""


def _qos(latched: bool) -> Qos:
    forever = QosTime(2147483647, 4294967295)
    durability = QosDurability.TRANSIENT_LOCAL if latched else QosDurability.VOLATILE
    return Qos(QosHistory.KEEP_LAST, 1 if latched else 1000, QosReliability.RELIABLE, durability,
               forever, forever, QosLiveliness.AUTOMATIC, forever, False)


class BagWriter:
    """A recording under ``path``, a new directory. Use it in a ``with``, on one thread.

    The ``with`` closes it after an exception too, so that it can be read. Raises BagError when the path exists or the
    disk fails.
    flush_period: time between flushes [s]; None: the library flushes, and equal messages give equal bytes.
    """

    def __init__(self, path: str | Path, *, storage: StoragePlugin = StoragePlugin.MCAP,
                 flush_period: float | None = FLUSH_PERIOD) -> None:
        self.path = Path(path)
        self._types = get_typestore(Stores.ROS2_JAZZY)
        self._connections: dict[str, Connection] = {}
        self._flush_period = np.inf if flush_period is None else flush_period
        self._flushed = time.monotonic()
        try:
            self._writer = Writer(self.path, version=9, storage_plugin=storage)
            self._writer.open()
        except WriterError as err:
            raise BagError(f"bag '{path}' exists already", 'remove it or give another name') from err
        except OSError as err:
            raise BagError(f"bag '{path}' cannot be written: {err.strerror}", 'give another place') from err

    def write(self, topic: str, log_ns: int, value: AnyValue, *, latched: bool = False) -> None:
        """Append a value as its message. log_ns: time of recording [ns], which must not decrease."""
        made = message(value, lambda kind, **fields: self._types.types[kind](**fields))
        kind = made.__msgtype__
        self.write_raw(topic, log_ns, bytes(self._types.serialize_cdr(made, kind)), kind, latched=latched)

    def write_raw(self, topic: str, log_ns: int, data: bytes, kind: str, *, latched: bool = False) -> None:
        """Append a serialized message. kind: its type, such as std_msgs/msg/Header."""
        try:
            if topic not in self._connections:
                self._connections[topic] = self._writer.add_connection(
                    topic, kind, typestore=self._types, offered_qos_profiles=[_qos(latched)])
            self._writer.write(self._connections[topic], log_ns, data)
            if time.monotonic() - self._flushed > self._flush_period:
                self.flush()
        except OSError as err:
            raise BagError(f"bag '{self.path}' cannot be written: {err.strerror}",
                           'free some space and write it again') from err

    def flush(self) -> None:
        """Flush now. A recorder calls this on a timer, as ``write`` flushes only when a message comes."""
        store = self._writer.storage
        if isinstance(store, McapWriter):
            if store.chunk.msgs:
                store.close_chunk()
            store.bio.flush()
        self._flushed = time.monotonic()

    def close(self) -> None:
        """Write index and metadata."""
        try:
            self._writer.close()
        except OSError as err:
            with contextlib.suppress(OSError):  # the rest of the buffer cannot be written either
                self._writer.abort()
            problem = f"bag '{self.path}' cannot be finished: {err.strerror}"
            if self._holds_messages():
                raise BagError(f'{problem}; its end is missing, earlier messages are on the disk',
                               "free some space, then run 'ros2 bag reindex'") from err
            raise BagError(f'{problem}; no message is on the disk', 'free some space, remove it, run again') from err

    def _holds_messages(self) -> bool:
        """Return whether a message can be read of a recording that was not finished."""
        with contextlib.suppress(DamagedError, OSError):
            return any(True for file in self.path.iterdir() if file.suffix in STORAGE for _ in salvaged(file))
        return False

    def __enter__(self) -> BagWriter:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()
