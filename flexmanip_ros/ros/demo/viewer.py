"""The live page beside the demonstration: node ``live_view`` in a process of its own."""

from __future__ import annotations

import json
import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from urllib.request import urlopen

import rclpy

from flexmanip_ros.errors import FlexmanipError

START_TIMEOUT_S = 20.0
END_TIMEOUT_S = 15.0


class ViewerError(FlexmanipError):
    """The live page could not be started."""


class Viewer:
    """The process and its page."""

    def __init__(self, process: subprocess.Popen[bytes], url: str) -> None:
        self.url = url
        self._process = process

    def pages(self) -> int:
        """Return how many pages are open."""
        try:
            with urlopen(self.url + 'state', timeout=1.0) as answer:
                return int(json.load(answer)['pages'])
        except OSError:
            return 0

    def wait(self) -> None:
        """Wait until the process ends."""
        self._process.wait()


@contextmanager
def viewer(arguments: Sequence[str]) -> Iterator[Viewer]:
    """Start ``live_view`` on the domain of this process with its ROS arguments; end it in the end.

    Raises ViewerError when it does not start, such as on a port that is in use; the node has logged why.
    """
    domain = rclpy.get_default_context().get_domain_id()
    # A session of its own: Ctrl-C at the terminal reaches the demonstration alone, which then ends the page.
    process = subprocess.Popen(
        [sys.executable, '-m', 'flexmanip_ros.ros.nodes.live_view', *ros_arguments(arguments)],
        env={**os.environ, 'ROS_DOMAIN_ID': str(domain)}, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
        start_new_session=True)
    try:
        yield Viewer(process, _url(process))
    finally:
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
        try:
            process.wait(END_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def ros_arguments(arguments: Sequence[str]) -> list[str]:
    """Return the arguments that are meant for ROS."""
    kept, inside = ['--ros-args'], False
    for item in arguments:
        if item == '--ros-args' or (inside and item == '--'):
            inside = item == '--ros-args'
        elif inside:
            kept.append(item)
    return kept


def _url(process: subprocess.Popen[bytes]) -> str:
    """Return the address that the node prints."""
    assert process.stdout is not None
    said, limit = b'', time.monotonic() + START_TIMEOUT_S
    while b'\n' not in said:
        ready, _, _ = select.select([process.stdout], [], [], max(limit - time.monotonic(), 0.0))
        more = os.read(process.stdout.fileno(), 4096) if ready else b''
        if not more:
            raise ViewerError('the live view did not start', 'see its log above, or leave --view away')
        said += more
    return next(word for word in said.decode().split() if word.startswith('http://'))
