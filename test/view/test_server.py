"""The server as a browser meets it: http.client over real sockets."""

from __future__ import annotations

import http.client
import json
import socket
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from flexmanip_ros.errors import FlexmanipError
from flexmanip_ros.view import server as module
from flexmanip_ros.view.server import HOST, Server


@pytest.fixture
def server() -> Iterator[Server]:
    made = Server('<p>the page</p>', 0, lambda: {'samples': 7})
    yield made
    made.close()


def wait(condition: Callable[[], Any], timeout: float = 10.0) -> Any:
    limit = time.monotonic() + timeout
    while time.monotonic() < limit:
        value = condition()
        if value:
            return value
        time.sleep(0.005)
    raise AssertionError('not in time')


def get(server: Server, path: str, method: str = 'GET', **headers: str) -> tuple[int, bytes, dict[str, str]]:
    connection = http.client.HTTPConnection(HOST, server.port, timeout=10)
    connection.request(method, path, headers=headers)
    answer = connection.getresponse()
    found = answer.status, answer.read(), dict(answer.getheaders())
    connection.close()
    return found


class Events:
    """A page: an open stream of events."""

    def __init__(self, server: Server) -> None:
        self._connection = http.client.HTTPConnection(HOST, server.port, timeout=10)
        self._connection.request('GET', '/events')
        self.answer = self._connection.getresponse()

    def next(self) -> tuple[str, Any]:
        """Return name and data of the next event; ('', None) at the end of the stream."""
        name, data = '', None
        for line in iter(self.answer.readline, b''):
            key, _, value = line.decode().rstrip('\n').partition(': ')
            if key == 'event':
                name = value
            elif key == 'data':
                data = json.loads(value)
            elif not key and name:
                return name, data
        return '', None

    def close(self) -> None:
        """Go away."""
        self.answer.close()
        self._connection.close()


def test_the_page_is_there_and_may_load_nothing_from_elsewhere(server: Server) -> None:
    code, body, headers = get(server, '/')
    assert (code, body) == (200, b'<p>the page</p>')
    assert headers['Content-Type'] == 'text/html; charset=utf-8'
    assert "default-src 'none'" in headers['Content-Security-Policy']


def test_it_listens_on_this_machine_alone(server: Server) -> None:
    assert server.url == f'http://127.0.0.1:{server.port}/'
    assert server.socket.getsockname()[0] == '127.0.0.1'


@pytest.mark.parametrize('method', ['POST', 'PUT', 'DELETE', 'PATCH'])
def test_nothing_can_be_written(server: Server, method: str) -> None:
    assert get(server, '/', method)[0] == 501


def test_what_is_not_there_is_not_found(server: Server) -> None:
    assert get(server, '/../setup.py')[0] == 404
    assert json.loads(get(server, '/state')[1]) == {'pages': 0, 'samples': 7}


def test_another_site_whose_name_leads_here_reads_nothing(server: Server) -> None:
    assert get(server, '/state', Host='evil.example:80')[0] == 403
    assert get(server, '/state', Host='localhost.evil.example')[0] == 403
    assert get(server, '/state', Host=f'localhost:{server.port}')[0] == 200


@pytest.mark.parametrize('host', [HOST, 'localhost'])
def test_a_browser_that_leaves_out_the_port_as_it_does_at_port_80_is_answered(server: Server, host: str) -> None:
    assert get(server, '/state', Host=host)[0] == 200


def test_every_page_gets_every_event_in_order(server: Server) -> None:
    pages = [Events(server) for _ in range(3)]
    for page in pages:
        assert page.answer.headers['Content-Type'] == 'text/event-stream'
        assert page.next()[0] == 'reset'
    for k in range(2000):
        server.feed.publish('frame', json.dumps({'k': k}))
    for page in pages:
        assert [page.next() for _ in range(2000)] == [('frame', {'k': k}) for k in range(2000)]
        page.close()
    server.feed.publish('frame', '{}')
    wait(lambda: server.feed.publish('frame', '{}') or server.pages == 0)


def test_a_page_that_opens_late_gets_what_was_and_of_another_run_nothing(
        server: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    server.feed.publish('frame', '{"run": 1}', lasting=True)
    server.feed.reset()
    server.feed.publish('frame', '{"event": 1}', lasting=True)
    server.feed.publish('frame', '{"k": 0}')
    monkeypatch.setattr(module, 'HISTORY_S', -1.0)  # all that does not last is too old
    server.feed.publish('frame', '{"k": 1}')
    page = Events(server)
    assert page.next()[0] == 'reset'
    assert page.next() == ('frame', {'event': 1})
    page.close()


def test_a_stuck_page_holds_nobody_up_fills_no_memory_and_is_let_go(
        server: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module._Handler, 'timeout', 0.5)
    monkeypatch.setattr(module, 'MOST_BYTES', 2_000_000)
    stuck = socket.create_connection((HOST, server.port))
    stuck.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    stuck.sendall(b'GET /events HTTP/1.0\r\nHost: localhost:1\r\n\r\n')
    wait(lambda: server.pages == 1)
    page, text, slowest = Events(server), json.dumps('x' * 100_000), 0.0
    got: list[str] = []
    reader = threading.Thread(target=lambda: got.extend(iter(lambda: page.next()[0], '')))
    reader.start()
    for _ in range(300):
        before = time.perf_counter()
        server.feed.publish('frame', text)
        slowest = max(slowest, time.perf_counter() - before)
        time.sleep(0.005)
    assert slowest < 0.2
    assert server.feed._bytes <= 2_000_000
    wait(lambda: server.pages <= 1)
    server.feed.publish('last', '{}')
    wait(lambda: 'last' in got or not reader.is_alive())
    stuck.close()
    server.close()
    reader.join(10)
    assert not reader.is_alive()
    assert got.count('frame') > 100


def test_a_connection_that_asks_for_nothing_is_let_go(server: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module._Handler, 'timeout', 0.2)
    silent = socket.create_connection((HOST, server.port), timeout=10)
    assert silent.recv(1) == b''
    silent.close()


def test_there_may_be_so_many_pages_and_no_more(server: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, 'MOST_PAGES', 2)
    pages = [Events(server) for _ in range(2)]
    assert get(server, '/events')[0] == 503
    for page in pages:
        page.close()


def test_a_port_in_use_is_named_with_the_way_out(server: Server) -> None:
    with pytest.raises(FlexmanipError, match=rf'port {server.port} of this machine is in use.*another port'):
        Server('', server.port)


def test_an_end_ends_every_page_and_gives_the_port_back(server: Server) -> None:
    page = Events(server)
    assert page.next()[0] == 'reset'
    began = time.monotonic()
    server.close()
    assert time.monotonic() - began < 5.0
    assert page.next() == ('', None)
    page.close()
    assert [thread.name for thread in threading.enumerate() if thread.name == 'http'] == []
    again = Server('', server.port)
    again.close()
