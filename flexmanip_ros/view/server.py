"""Serve the page and its events over HTTP, on this machine alone, read-only, with the standard library.

``/`` is the page, ``/events`` a stream of Server-Sent Events, ``/state`` a few counts as JSON. The events of the last
``HISTORY_S`` seconds are kept once for all pages, and each page reads them at its own pace on a thread of its own. A
page that falls further behind is disconnected. It connects again by itself and begins with the history.
"""

from __future__ import annotations

import contextlib
import errno
import json
import socket
import socketserver
import threading
import time
import zlib
from collections import deque
from collections.abc import Callable, Mapping
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler
from typing import Any

from flexmanip_ros.errors import FlexmanipError

HOST = '127.0.0.1'
HISTORY_S = 35.0
"""Time for which events are kept [s], so that a page that opens late shows at least its longest window."""
MOST_BYTES = 64_000_000
"""Largest size of the kept events [bytes]."""
MOST_LASTING = 200
MOST_PAGES = 16
STUCK_S = 5.0
"""Time after which a page that takes no byte is disconnected [s]."""
BEAT_S = 1.0
"""Longest time without data to a page [s]. Sending data shows whether the page has gone."""
POLICY = "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; connect-src 'self'; " \
    "img-src data:"


class Feed:
    """Numbered events in order, which each page reads at its own pace."""

    def __init__(self, page: bytes) -> None:
        self._changed = threading.Condition()
        # The checksum of the page: a page that connects again and gets another checksum loads the new page.
        self._reset = f'{{"page":{zlib.crc32(page)}}}'
        self._lasting: deque[bytes] = deque(maxlen=MOST_LASTING)
        """Events that a page needs whenever it opens."""
        self._recent: deque[tuple[float, bytes]] = deque()
        self._bytes = 0
        self._next = 0
        """Number of the next event."""
        self.closed = False

    def publish(self, name: str, text: str, *, lasting: bool = False) -> None:
        """Send an event to every page. text: JSON in one line; lasting: keep it for pages that open later."""
        event = f'event: {name}\ndata: {text}\n\n'.encode()
        now = time.monotonic()
        with self._changed:
            if lasting:
                self._lasting.append(event)
            self._recent.append((now, event))
            self._bytes += len(event)
            self._next += 1
            while self._recent and (self._recent[0][0] < now - HISTORY_S or self._bytes > MOST_BYTES):
                self._bytes -= len(self._recent.popleft()[1])
            self._changed.notify_all()

    def reset(self) -> None:
        """Drop all kept events and tell every page to begin again, as a new run begins."""
        with self._changed:
            self._lasting.clear()
            self._recent.clear()
            self._bytes = 0
        self.publish('reset', self._reset)

    def greeting(self) -> tuple[int, bytes]:
        """Return the number of the next event, and the events that a page needs when it opens now."""
        with self._changed:
            reset = f'event: reset\ndata: {self._reset}\n\n'.encode()
            return self._next, b''.join([reset, *self._lasting, *(event for _, event in self._recent)])

    def after(self, number: int) -> tuple[int, bytes] | None:
        """Return the events from a number on; None if these are dropped or the feed is closed.

        The call waits up to ``BEAT_S`` for an event. A page may get a lasting event twice; it shows that event once.
        """
        with self._changed:
            if not self.closed and number == self._next:
                self._changed.wait(BEAT_S)
            count = self._next - number
            if self.closed or count > len(self._recent):
                return None
            waiting = [self._recent[k][1] for k in range(-count, 0)]
            return self._next, b''.join(waiting) or b': nothing new\n\n'

    def close(self) -> None:
        """Disconnect every page."""
        with self._changed:
            self.closed = True
            self._changed.notify_all()


class Server(socketserver.ThreadingTCPServer):
    """Serves a page until it is closed. Raises FlexmanipError when the port cannot be opened.

    page: the HTML; state: returns numbers for ``/state``, called on a thread of the server. The base is not HTTPServer,
    which looks up the name of the machine when it starts.
    """

    allow_reuse_address = True
    daemon_threads = True  # a process that ends in a hurry waits for no page
    block_on_close = False

    def __init__(self, page: str, port: int, state: Callable[[], Mapping[str, Any]] = dict) -> None:
        self.page = page.encode()
        self.feed = Feed(self.page)
        self.state = state
        self.pages = 0
        """Number of pages that are open."""
        self.pages_changed = threading.Condition()
        self._connections: set[Any] = set()
        try:
            super().__init__((HOST, port), _Handler)
        except OSError as error:
            if error.errno == errno.EADDRINUSE:
                raise FlexmanipError(
                    f'port {port} of this machine is in use',
                    'end the program that has it, or give another port (0: any that is free)') from error
            raise FlexmanipError(f'port {port} cannot be opened: {error.strerror}',
                                 'give a port from 1024 up (0: any that is free)') from error
        self.port = int(self.server_address[1])
        self._thread = threading.Thread(target=self.serve_forever, args=(0.2,), name='http', daemon=True)
        self._thread.start()

    @property
    def url(self) -> str:
        """Address of the page."""
        return f'http://{HOST}:{self.port}/'

    @property
    def invitation(self) -> str:
        """Text that tells a user how to open the page."""
        return f'open {self.url} in a browser on this machine'

    def finish_request(self, request: Any, client_address: Any) -> None:
        """Answer a request, on a thread of its own; its connection is noted, so that it can be ended."""
        self._connections.add(request)
        try:
            super().finish_request(request, client_address)
        finally:
            self._connections.discard(request)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore the error: it means that a page has gone."""

    def close(self) -> None:
        """Disconnect every page and release the port. Calling it again does nothing."""
        if self.feed.closed:
            return
        self.feed.close()
        self.shutdown()
        for connection in list(self._connections):
            with contextlib.suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)  # ends a write to a page that reads nothing
        self.server_close()
        self._thread.join()
        with self.pages_changed:
            self.pages_changed.wait_for(lambda: self.pages == 0, STUCK_S)


class _Handler(BaseHTTPRequestHandler):
    """One connection, one answer."""

    server: Server
    timeout = STUCK_S
    server_version, sys_version = 'flexmanip_ros', ''

    def do_GET(self) -> None:
        """Answer a GET; the base class answers every other method with 501."""
        server, path = self.server, self.path.partition('?')[0]
        try:
            # Another site whose name resolves to this address could read the data.
            if self.headers.get('Host', '').partition(':')[0] not in (HOST, 'localhost'):
                self.send_error(HTTPStatus.FORBIDDEN, f'open {server.url}')
            elif path == '/':
                self._answer('text/html; charset=utf-8', server.page)
            elif path == '/state':
                self._answer('application/json', json.dumps({'pages': server.pages, **server.state()}).encode())
            elif path == '/events':
                self._stream()
            else:
                self.send_error(HTTPStatus.NOT_FOUND)
        except OSError:  # the page has gone, or took no byte for STUCK_S
            self.close_connection = True

    def _stream(self) -> None:
        server = self.server
        with server.pages_changed:
            if server.pages >= MOST_PAGES:
                self.send_error(HTTPStatus.SERVICE_UNAVAILABLE, f'{MOST_PAGES} pages are open already')
                return
            server.pages += 1
        try:
            self._answer('text/event-stream')
            number, data = server.feed.greeting()
            self.wfile.write(data)
            while (found := server.feed.after(number)) is not None:
                number, data = found
                self.wfile.write(data)
        finally:
            with server.pages_changed:
                server.pages -= 1
                server.pages_changed.notify_all()

    def _answer(self, kind: str, body: bytes | None = None) -> None:
        """Send the head and, where there is one, the body."""
        self.send_response(HTTPStatus.OK)
        self.send_header('Content-Type', kind)
        if body is not None:
            self.send_header('Content-Length', str(len(body)))
        self.send_header('Cache-Control', 'no-store')
        self.send_header('Content-Security-Policy', POLICY)
        self.send_header('X-Content-Type-Options', 'nosniff')
        self.end_headers()
        if body is not None:
            self.wfile.write(body)

    def log_message(self, format: str, *arguments: Any) -> None:
        """Log nothing, as the log belongs to the node."""
