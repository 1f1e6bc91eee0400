"""Where estimates go: a table at the end, or a recording as they come."""

from __future__ import annotations

import os
from pathlib import Path
from types import TracebackType
from typing import Protocol

from flexmanip_ros.errors import BagError
from flexmanip_ros.io import table
from flexmanip_ros.io.bag_writer import BagWriter
from flexmanip_ros.messages import MODES, PAYLOAD_MASS, outgoing
from flexmanip_ros.types import Estimate

NODE = 'rpbsid_identifier'


class Output(Protocol):
    """Takes estimates one by one; ``close`` makes them permanent, after an exception too."""

    def write(self, estimate: Estimate) -> None:
        """Take one estimate."""

    def close(self) -> None:
        """Finish."""


class TableOutput:
    """A .csv or .npz file, written when closed."""

    def __init__(self, path: Path) -> None:
        table.check_place(path)
        self.path = path
        self.estimates: list[Estimate] = []
        self.start_ns: int | None = None

    def write(self, estimate: Estimate) -> None:
        """Keep one row."""
        self.estimates.append(estimate)

    def close(self) -> None:
        """Write the file."""
        writer = table.write_csv if self.path.suffix == '.csv' else table.write_npz
        writer(self.path, self.estimates, self.start_ns)


class BagOutput:
    """A recording with the identifier's topics, stamped as the input; made with the first estimate."""

    def __init__(self, path: Path, frame_id: str, node: str = NODE) -> None:
        if os.path.exists(path):  # a name too long is for check_place to say
            raise BagError(f"'{path}' exists already", 'remove it or give another name')
        table.check_place(path)
        self._path = path
        self._frame_id = frame_id
        self._node = node
        self._writer: BagWriter | None = None

    def write(self, estimate: Estimate) -> None:
        """Append what the node would have published."""
        writer = self._opened()
        for name, value in outgoing(estimate, self._frame_id):
            latched = name not in (MODES, PAYLOAD_MASS)
            writer.write(f'/{self._node}/{name}', estimate.stamp_ns, value, latched=latched)

    def close(self) -> None:
        """Finish the recording."""
        self._opened().close()

    def _opened(self) -> BagWriter:
        if self._writer is None:
            self._writer = BagWriter(self._path)
        return self._writer


class Outputs:
    """Several outputs as one; closes all of them, whatever happens. Nothing is left of a run of nothing."""

    def __init__(self, *outputs: Output) -> None:
        self._outputs = outputs
        self._written = False

    def write(self, estimate: Estimate) -> None:
        """Hand one estimate to each."""
        self._written = True
        for output in self._outputs:
            output.write(estimate)

    def __enter__(self) -> Outputs:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        if kind is None or self._written:
            for output in self._outputs:
                output.close()


def open_output(path: str | Path, frame_id: str) -> Output:
    """Return the output a name asks for: .csv or .npz a table, anything else a recording."""
    path = Path(path)
    return TableOutput(path) if path.suffix in ('.csv', '.npz') else BagOutput(path, frame_id)
