"""Nodes of a test in one context, each spun as in its process; everything waits with a time-out."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from functools import cache
from typing import Any, TypeVar

import rclpy
from rclpy.context import Context
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from rclpy.signals import SignalHandlerOptions

from flexmanip_ros.ros.nodes import capture_trigger, rpbsid_identifier
from flexmanip_ros.ros.rclpy_workarounds import make_executor

# Kernels that are loaded stay loaded in a process: a node of the same configuration does not load them again.
for _module in (capture_trigger, rpbsid_identifier):
    _module.warm_up = cache(_module.warm_up)

Found = TypeVar('Found', bound=Node)


class Spun:
    """A node on an executor and a thread of its own, which end in the order of ``ros.node.run``.

    The events executor of rclpy 7.1 must not lose entities while it spins: an event of one that has gone by then ends
    the process with a segmentation fault, or raises InvalidHandle (https://github.com/ros2/rclpy/issues/1644).
    """

    def __init__(self, node: Node, context: Context) -> None:
        self.node = node
        self.executor = make_executor(context)
        self.failure: BaseException | None = None
        self.jobs: deque[Callable[[], Any]] = deque()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._spin, name=node.get_name())
        self._thread.start()

    def _spin(self) -> None:
        try:
            self.executor.add_node(self.node)
            while not self._stop.is_set():
                self.executor.spin_once(timeout_sec=0.02)
                if self.jobs:
                    self.jobs[0]()
                    self.jobs.popleft()
            if hasattr(self.node, 'close'):
                self.node.close()
        except BaseException as error:  # shown by the test that waits
            self.failure = error
        finally:
            self.executor.shutdown()
            self.node.destroy_node()

    def end(self) -> None:
        """Stop and destroy the node as its process would end."""
        self._stop.set()
        self._thread.join()


class Ros:
    """One context, its nodes, and helpers that wait with a time-out."""

    def __init__(self, domain: int) -> None:
        self.domain = domain
        self.context = Context()
        rclpy.init(context=self.context, domain_id=domain, signal_handler_options=SignalHandlerOptions.NO)
        self._spun: list[Spun] = []
        self.helper = self.add(Node('helper', context=self.context))

    def add(self, node: Found) -> Found:
        """Spin a node."""
        self._spun.append(Spun(node, self.context))
        self.wait(lambda: node.executor is not None, what='an executor')
        return node

    def managed(self, node: Any) -> Any:
        """Spin a node of the package, configured and active."""
        self.add(node)
        self.run(node, node.autostart)
        return node

    def run(self, node: Node, job: Callable[[], Any]) -> None:
        """Do something on the thread of a node, as its process does, and wait for it."""
        spun = self._of(node)
        spun.jobs.append(job)
        self.wait(lambda: not spun.jobs, timeout=300.0, what='what runs beside the callbacks')

    def remove(self, node: Any) -> None:
        """Stop and destroy a node as its process would end."""
        spun = self._of(node)
        spun.end()
        self._raise()
        self._spun.remove(spun)

    def _raise(self) -> None:
        """Raise what ended a node, once."""
        for spun in self._spun:
            if spun.failure is not None:
                failure, spun.failure = spun.failure, None
                raise failure

    def _of(self, node: Node) -> Spun:
        return next(spun for spun in self._spun if spun.node is node)

    def wait(self, condition: Callable[[], Any], timeout: float = 15.0, what: str = '') -> Any:
        """Return the first true value of a condition; fail after the time-out."""
        limit = time.monotonic() + timeout
        while time.monotonic() < limit:
            self._raise()
            value = condition()
            if value:
                return value
            time.sleep(0.002)
        raise AssertionError(f'not within {timeout} s: {what or condition}')

    def listen(self, kind: type, topic: str, profile: QoSProfile | int = 1000, node: Node | None = None) -> list[Any]:
        """Return a list that fills with what comes on a topic; node: who takes it, after what came before."""
        heard: list[Any] = []
        node = node or self.helper
        self.run(node, lambda: node.create_subscription(kind, topic, heard.append, profile))
        return heard

    def publisher(self, kind: type, topic: str, profile: QoSProfile | int = 1000, readers: int = 1) -> Any:
        """Return a publisher that already has its readers."""
        made = self.helper.create_publisher(kind, topic, profile)
        self.wait(lambda: made.get_subscription_count() >= readers, what=f'a reader of {topic}')
        return made

    def call(self, kind: type, name: str, request: Any = None) -> Any:
        """Return the response of a service."""
        client = self.helper.create_client(kind, name)
        self.wait(client.service_is_ready, what=f'service {name}')
        future = client.call_async(kind.Request() if request is None else request)
        self.wait(future.done, what=f'answer of {name}')
        return future.result()

    def close(self) -> None:
        """End the nodes, the latest first."""
        for spun in reversed(self._spun):
            spun.end()
        rclpy.shutdown(context=self.context)
        self._raise()


def overrides(**values: Any) -> list[Parameter]:
    """Return parameters; a double underscore stands for a dot."""
    return [Parameter(name.replace('__', '.'), value=value) for name, value in values.items()]
