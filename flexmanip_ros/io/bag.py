"""Recordings (rosbag2, sqlite3 or mcap) -> the messages the identifier takes, in recorded order."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rosbags.rosbag2 import Reader

from flexmanip_ros.errors import BagError
from flexmanip_ros.io import cdr, salvage
from flexmanip_ros.types import CaptureEvent, JointRecord

JOINT_STATE = 'sensor_msgs/msg/JointState'
HEADER = 'std_msgs/msg/Header'
REPORT_EVERY = 256
"""Messages between two calls of the progress hook."""

Item = JointRecord | CaptureEvent
Progress = Callable[[int, int | None], None]
"""Called with messages read and messages there (None when the recording does not say)."""


@dataclass(frozen=True)
class Topics:
    """Where to look. Without a leading slash a name is found in any one namespace."""

    joint_states: str = 'joint_states'
    events: tuple[str, ...] = ('capture_event', 'capture_detected')
    events_required: bool = False


def read(path: str | Path, topics: Topics | None = None, progress: Progress | None = None) -> Iterator[Item]:
    """Yield the joint states and events of a bag (its directory, or the .mcap or .db3 file itself).

    Of a damaged recording everything before the fault is yielded, then BagError says what is wrong, so that
    nothing recorded is lost and no damage goes unseen.
    """
    decode = _Decoder(Path(path), topics or Topics(), progress)
    try:
        yield from decode.healthy()
    except _GaveUpError as broken:
        yield from decode.salvaged(broken)
    decode.finish()


class _GaveUpError(Exception):
    """The library gave up; what came out before stays."""


class _Decoder:
    """One pass over one bag."""

    def __init__(self, path: Path, topics: Topics, progress: Progress | None) -> None:
        self.path = path
        self.topics = topics
        self.progress = progress
        self.joint_topic = ''
        self.joint_states = 0
        self.taken = 0
        self.total: int | None = None
        self.kinds: dict[str, str] = {}
        self.faults: list[str] = []
        self._layout: cdr.Layout | None = None
        try:
            self._look()
        except OSError as err:
            raise BagError(f"bag '{path}' cannot be read: {err.strerror}", 'check the permissions') from err

    def _look(self) -> None:
        """Say at once what cannot be a bag."""
        path = self.path
        if not path.exists():
            raise BagError(f"bag '{path}' does not exist", 'check the path')
        if path.suffix == '.bag':
            raise BagError(f"'{path}' is a ROS 1 bag", 'convert it: rosbags-convert --src FILE --dst FOLDER')
        if path.is_file() and path.suffix not in ('.mcap', '.db3'):
            raise BagError(f"'{path}' is not a bag", 'give a rosbag2 directory, an .mcap or a .db3 file')
        if path.is_dir() and not (path / 'metadata.yaml').is_file() and not self._files():
            raise BagError(f"directory '{path}' is not a bag: metadata.yaml and recording are missing",
                           'give the directory that ros2 bag record made')
        if any(file.stat().st_size == 0 for file in self._files()):
            raise BagError(f"bag '{path}' is empty", 'record again; the recorder was stopped before it wrote')

    def _files(self) -> list[Path]:
        if self.path.is_file():
            return [self.path]
        return sorted(file for file in self.path.iterdir() if file.suffix in ('.mcap', '.db3'))

    def healthy(self) -> Iterator[Item]:
        """Read with the library; whatever it trips over becomes _GaveUpError."""
        try:
            reader = Reader(self.path)
            reader.open()
        except Exception as err:  # broken bytes lead it to errors of many kinds
            raise _GaveUpError(_reason(err)) from err
        with closing(reader):
            self._choose({connection.topic: connection.msgtype for connection in reader.connections})
            chosen = [item for item in reader.connections if item.topic in self.kinds]
            self.total = sum(connection.msgcount for connection in chosen)
            stream = reader.messages(connections=chosen)
            while True:
                try:
                    connection, _, data = next(stream)
                except StopIteration:
                    return
                except Exception as err:
                    raise _GaveUpError(_reason(err)) from err
                yield from self._decoded(connection.topic, bytes(data))

    def salvaged(self, broken: _GaveUpError) -> Iterator[Item]:
        """Read on, message by message, from where the library gave up; always ends with BagError."""
        skip = self.taken
        self.total = None
        fault = str(broken)
        for file in self._files():
            try:
                for raw in salvage.messages(file):
                    if not self._choose({raw.topic: raw.msgtype}, complete=False):
                        continue
                    if skip:
                        skip -= 1
                        continue
                    yield from self._decoded(raw.topic, raw.data)
            except salvage.DamagedError as err:
                fault = str(err)
                break
        if self.joint_states == 0:
            raise BagError(f"bag '{self.path}' cannot be read: {fault}",
                           'check that it is a rosbag2 recording and copied whole')
        raise BagError(f"bag '{self.path}' is damaged: {fault}; {self._read_so_far()}",
                       "repair it with 'ros2 bag reindex' or 'mcap recover', or record again")

    def finish(self) -> None:
        """Report the end, and what was wrong on the way."""
        if self.progress is not None:
            self.progress(self.taken, self.taken)
        if self.joint_states == 0 and not self.faults:
            raise BagError(f"bag '{self.path}' has no message on '{self.joint_topic}'",
                           'record while the joint states are published')
        if self.faults:
            more = f' (and {len(self.faults) - 1} more)' if len(self.faults) > 1 else ''
            raise BagError(f"bag '{self.path}': {self.faults[0]}{more}; {self._read_so_far()}",
                           'correct the publisher and record again')

    def _read_so_far(self) -> str:
        return f"{self.joint_states} messages on '{self.joint_topic}' were read"

    def _decoded(self, topic: str, data: bytes) -> Iterator[Item]:
        self.taken += 1
        if self.progress is not None and self.taken % REPORT_EVERY == 0:
            self.progress(self.taken, self.total)
        try:
            if topic == self.joint_topic:
                record, self._layout = cdr.joint_record(data, self._layout)
                self.joint_states += 1
                yield record
            else:
                yield cdr.capture_event(data)
        except (cdr.CdrError, UnicodeDecodeError) as err:
            self.faults.append(f"message {self.taken} (on '{topic}') is garbled: {err}")
        except ValueError as err:
            self.faults.append(f"an event on '{topic}' is neither capture nor release: {err}")

    def _choose(self, there: dict[str, str], *, complete: bool = True) -> bool:
        """Settle which topics are read; tell whether one of ``there`` is."""
        if not self.joint_topic:
            found = _resolve(self.topics.joint_states, there, JOINT_STATE, self.path)
            if found is None and complete:
                listed = ', '.join(f'{name} ({kind})' for name, kind in sorted(there.items())) or 'none'
                raise BagError(f"bag '{self.path}' has no topic '{self.topics.joint_states}'",
                               f'the topics there are: {listed}')
            if found is not None:
                self.joint_topic = found
                self.kinds[found] = JOINT_STATE
        spaces = (self.joint_topic.rpartition('/')[0], '')
        for name in self.topics.events:
            near = there if name.startswith('/') else {
                topic: kind for topic, kind in there.items() if topic.rpartition('/')[0] in spaces}
            event = _resolve(name, near, HEADER, self.path)
            if event is not None:
                self.kinds[event] = HEADER
            elif complete and self.topics.events_required:
                listed = ', '.join(sorted(topic for topic, kind in there.items() if kind == HEADER)) or 'none'
                raise BagError(f"bag '{self.path}' has no topic '{name}'",
                               f'the event topics there are: {listed}')
        return any(topic in self.kinds for topic in there)


def _resolve(wanted: str, there: dict[str, str], kind: str, path: Path) -> str | None:
    """Find a topic by its name, in any namespace when that is unambiguous."""
    exact = wanted if wanted.startswith('/') else '/' + wanted
    names: Sequence[str] = [name for name in there if name in (wanted, exact)]
    if not names and not wanted.startswith('/'):
        names = [name for name in there if name.endswith(exact)]
    if not names:
        return None
    if len(names) > 1:
        raise BagError(f"bag '{path}' has several topics '{wanted}': {', '.join(sorted(names))}",
                       'give the full name with its leading slash')
    if there[names[0]] != kind:
        raise BagError(f"topic '{names[0]}' in bag '{path}' is {there[names[0]]}, not {kind}",
                       'name another topic, or record the right type')
    return names[0]


def _reason(err: Any) -> str:
    text = ' '.join(str(err).split()) or type(err).__name__
    return text.rstrip('.')
