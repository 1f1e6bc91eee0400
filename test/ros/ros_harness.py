"""Nodes of a test on one context, spun by a thread; everything waits with a time-out."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any, TypeVar

import rclpy
from rclpy.context import Context
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from rclpy.signals import SignalHandlerOptions

from flexmanip_ros.ros.rclpy_workarounds import make_executor

Found = TypeVar('Found', bound=Node)


class Ros:
    """One context, its executor on a thread, and helpers that wait with a time-out."""

    def __init__(self, domain: int) -> None:
        self.domain = domain
        self.context = Context()
        rclpy.init(context=self.context, domain_id=domain, signal_handler_options=SignalHandlerOptions.NO)
        self.executor = make_executor(self.context)
        self._nodes: list[Node] = []
        self._stop = threading.Event()
        self._jobs: deque[Callable[[], Any]] = deque()
        self.failure: BaseException | None = None
        self._thread = threading.Thread(target=self._spin, name='executor')
        self.helper = self.add(Node('helper', context=self.context))
        self._thread.start()

    def _spin(self) -> None:
        try:
            while not self._stop.is_set():
                self.executor.spin_once(timeout_sec=0.02)
                if self._jobs:
                    self._jobs[0]()
                    self._jobs.popleft()
        except BaseException as error:  # shown by close(), on the thread of the test
            self.failure = error

    def add(self, node: Found) -> Found:
        """Spin a node."""
        self._nodes.append(node)
        self.executor.add_node(node)
        return node

    def managed(self, node: Any) -> Any:
        """Spin a node of the package, configured and active."""
        self.add(node)
        self.run(node.autostart)
        return node

    def run(self, *jobs: Callable[[], Any]) -> None:
        """Do something on the thread of the executor, as a process does, and wait for it; one job after each spin."""
        self._jobs.extend(jobs)
        self.wait(lambda: not self._jobs, timeout=300.0, what='what runs beside the callbacks')

    def remove(self, node: Any) -> None:
        """Stop and destroy a node as its process would end: on the thread of the executor.

        That lets go of what a node has when it spins next.
        """
        self._nodes.remove(node)
        self.run(node.close, lambda: self.executor.remove_node(node), node.destroy_node)

    def wait(self, condition: Callable[[], Any], timeout: float = 15.0, what: str = '') -> Any:
        """Return the first true value of a condition; fail after the time-out."""
        limit = time.monotonic() + timeout
        while time.monotonic() < limit:
            if self.failure is not None:
                raise self.failure
            value = condition()
            if value:
                return value
            time.sleep(0.002)
        raise AssertionError(f'not within {timeout} s: {what or condition}')

    def listen(self, kind: type, topic: str, profile: QoSProfile | int = 1000) -> list[Any]:
        """Return a list that fills with what comes on a topic."""
        heard: list[Any] = []
        self.helper.create_subscription(kind, topic, heard.append, profile)
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
        """End everything in the order that leaves nothing running."""
        self._stop.set()
        self._thread.join()
        for node in self._nodes:
            if hasattr(node, 'close'):
                node.close()
        self.executor.shutdown()
        for node in self._nodes:
            node.destroy_node()
        rclpy.shutdown(context=self.context)
        if self.failure is not None:
            raise self.failure


def overrides(**values: Any) -> list[Parameter]:
    """Return parameters; a double underscore stands for a dot."""
    return [Parameter(name.replace('__', '.'), value=value) for name, value in values.items()]
