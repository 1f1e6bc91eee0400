"""When the next sample is due: on the steady clock, or on simulated time when that is in use."""

from __future__ import annotations

from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node


class SampleGrid:
    """A uniform grid of instants that begins at ``begin``: instant k is k / rate seconds later.

    On the wall clock elapsed time is steady, so a correction of the system clock moves no stamp.
    """

    def __init__(self, node: Node, rate: float) -> None:
        self._simulated = bool(node.get_parameter('use_sim_time').value)
        self._ros = node.get_clock()
        self.clock: Clock = self._ros if self._simulated else Clock(clock_type=ClockType.STEADY_TIME)
        self.rate = rate
        self.start_ns = 0
        self._origin_ns: int | None = None

    def begin(self) -> bool:
        """Set instant 0 to now; False while simulated time has not come yet."""
        self.start_ns = int(self._ros.now().nanoseconds)
        self._origin_ns = int(self.clock.now().nanoseconds) if self.start_ns > 0 else None
        return self._origin_ns is not None

    @property
    def begun(self) -> bool:
        """Whether instant 0 is set."""
        return self._origin_ns is not None

    def stop(self) -> None:
        """Forget instant 0."""
        self._origin_ns = None

    def latest(self) -> int:
        """Return the index of the latest instant reached; negative when the clock went back before 0."""
        assert self._origin_ns is not None
        elapsed_ns = int(self.clock.now().nanoseconds) - self._origin_ns
        return int(elapsed_ns * self.rate / 1e9 + 1e-6) if elapsed_ns >= 0 else -1
