"""A headless Chromium through its debugging pipe (standard library alone); a test is skipped where there is none."""

from __future__ import annotations

import base64
import json
import os
import select
import shutil
import subprocess
import time
from pathlib import Path
from typing import Any

import pytest

NAMES = ('chromium', 'chromium-browser', 'google-chrome', 'chrome', 'chrome-headless-shell', 'chromium-headless-shell')
VARIABLE = 'FLEXMANIP_BROWSER'
"""Environment variable with the path of a Chromium that is not on the PATH."""


class Browser:
    """One page. Close it in the end."""

    def __init__(self, folder: Path, size: tuple[int, int] = (1280, 800)) -> None:
        found = os.environ.get(VARIABLE) or next(filter(None, map(shutil.which, NAMES)), None)
        if found is None:
            pytest.skip(f'no Chromium is installed, and {VARIABLE} names none')
        to_read, self._out = os.pipe()
        self._in, to_write = os.pipe()

        def connect() -> None:
            """Put the pipe where Chromium looks for it."""
            ends = os.dup(to_read), os.dup(to_write)
            os.dup2(ends[0], 3)
            os.dup2(ends[1], 4)

        self._process = subprocess.Popen(
            [found, '--headless', '--no-sandbox', '--disable-gpu', '--no-first-run', '--remote-debugging-pipe',
             f'--user-data-dir={folder}', f'--window-size={size[0]},{size[1]}', '--hide-scrollbars'],
            close_fds=False, preexec_fn=connect, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL)
        os.close(to_read)
        os.close(to_write)
        self._number, self._buffer = 0, b''
        self.complaints: list[str] = []
        """Exceptions and refused loads that the page reported."""
        target = self._ask('Target.createTarget', {'url': 'about:blank'})['targetId']
        self._session = self._ask('Target.attachToTarget', {'targetId': target, 'flatten': True})['sessionId']
        self._ask('Runtime.enable')
        self._ask('Log.enable')
        self._ask('Emulation.setDeviceMetricsOverride', {
            'width': size[0], 'height': size[1], 'deviceScaleFactor': 1, 'mobile': False})

    def _ask(self, method: str, parameters: dict[str, Any] | None = None, timeout: float = 30.0) -> dict[str, Any]:
        self._number += 1
        message = {'id': self._number, 'method': method, 'params': parameters or {}}
        if hasattr(self, '_session'):
            message['sessionId'] = self._session
        os.write(self._out, json.dumps(message).encode() + b'\0')
        limit = time.monotonic() + timeout
        while True:
            while b'\0' not in self._buffer:
                ready, _, _ = select.select([self._in], [], [], max(limit - time.monotonic(), 0.0))
                assert ready, f'no answer to {method} within {timeout} s'
                data = os.read(self._in, 1 << 20)
                assert data, 'Chromium has ended'
                self._buffer += data
            text, _, self._buffer = self._buffer.partition(b'\0')
            answer = json.loads(text)
            if answer.get('method') == 'Runtime.exceptionThrown':
                details = answer['params']['exceptionDetails']
                self.complaints.append(details.get('exception', details).get('description', str(details)))
            elif answer.get('method') == 'Log.entryAdded' and answer['params']['entry']['level'] == 'error':
                self.complaints.append(answer['params']['entry']['text'])
            if answer.get('id') == self._number:
                assert 'error' not in answer, answer
                result: dict[str, Any] = answer['result']
                return result

    def open(self, url: str) -> None:
        """Go to a page."""
        self._ask('Page.enable')
        self._ask('Page.navigate', {'url': url})

    def value(self, script: str) -> Any:
        """Return the value of an expression on the page; None while there is none."""
        answer = self._ask('Runtime.evaluate', {'expression': script, 'returnByValue': True, 'awaitPromise': True})
        return answer['result'].get('value')

    def wait(self, script: str, timeout: float = 30.0) -> Any:
        """Return the first true value of an expression."""
        limit = time.monotonic() + timeout
        while time.monotonic() < limit:
            value = self.value(f'(() => {{ try {{ return {script}; }} catch (error) {{ return null; }} }})()')
            if value:
                return value
            time.sleep(0.05)
        raise AssertionError(f'not within {timeout} s: {script}; the page said {self.complaints}')

    def text(self, name: str) -> str:
        """Return the text of an element."""
        return str(self.value(f'document.getElementById({name!r}).innerText'))

    def picture(self, path: Path) -> bytes:
        """Write what is seen, as PNG."""
        data = base64.b64decode(self._ask('Page.captureScreenshot')['data'])
        path.write_bytes(data)
        return data

    def close(self) -> None:
        """End the browser."""
        self._process.terminate()
        try:
            self._process.wait(timeout=10)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait(timeout=10)
        os.close(self._out)
        os.close(self._in)
