"""A headless Chromium that tests open pages in, by the DevTools protocol."""

import base64
import functools
import http.server
import io
import itertools
import json
import shutil
import subprocess
import threading
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8
from PIL import Image

NAMES = ("chromium", "chromium-browser", "google-chrome")
#: Nothing but the page is loaded, and WebGL is computed on the CPU.
ARGUMENTS = (
    "--headless=new",
    "--no-sandbox",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--force-color-profile=srgb",
    "--hide-scrollbars",
    "--remote-debugging-port=0",
)
STARTED_WITHIN_S = 60.0


def browser_path() -> str | None:
    """The program, where there is one."""
    return next(filter(None, map(shutil.which, NAMES)), None)


class Page:
    """One page of a browser; what it complained about is in `complaints`."""

    def __init__(self, address: str) -> None:
        """Connect to a page's DevTools."""
        from websockets.sync.client import connect

        self._socket = connect(address, max_size=None, open_timeout=STARTED_WITHIN_S)
        self._numbers = itertools.count(1)
        self.complaints: list[str] = []
        for domain in ("Page", "Runtime", "Log", "Network"):
            self._call(f"{domain}.enable")

    def open(self, url: str, width: int, height: int) -> None:
        """Go to an address in a window of that size; complaints of the page before are forgotten."""
        self.complaints.clear()
        self._call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)
        self._call("Page.navigate", url=url)

    def value(self, expression: str) -> Any:
        """Of an expression of JavaScript, or of what its promise comes to."""
        found = self._call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        return found["result"].get("value")

    def wait_until(self, met: Callable[[], bool], seconds: float) -> float:
        """Ask until it is met; how many seconds that took. Raises TimeoutError with the complaints."""
        start = time.monotonic()
        while not met():
            if time.monotonic() - start > seconds:
                raise TimeoutError(f"not met within {seconds} s; complaints: {self.complaints}")
            time.sleep(0.1)
        return time.monotonic() - start

    def picture(self) -> UInt8[np.ndarray, "H W 3"]:
        """What the window shows."""
        data = self._call("Page.captureScreenshot", format="png")["data"]
        return np.array(Image.open(io.BytesIO(base64.b64decode(data))).convert("RGB"))

    def _call(self, method: str, **parameters: Any) -> dict[str, Any]:
        number = next(self._numbers)
        self._socket.send(json.dumps({"id": number, "method": method, "params": parameters}))
        while True:
            message = json.loads(self._socket.recv(timeout=STARTED_WITHIN_S))
            if message.get("id") == number:
                assert "error" not in message, message["error"]
                result: dict[str, Any] = message["result"]
                return result
            self._note(message)

    def _note(self, message: dict[str, Any]) -> None:
        event, facts = message.get("method"), message.get("params", {})
        if event == "Runtime.exceptionThrown":
            self.complaints.append(json.dumps(facts["exceptionDetails"])[:500])
        elif event == "Log.entryAdded" and facts["entry"]["level"] == "error":
            self.complaints.append(f"{facts['entry']['text']} {facts['entry'].get('url', '')}")
        elif event == "Network.loadingFailed":
            self.complaints.append(f"{facts['type']}: {facts['errorText']}")


@contextmanager
def opened_browser(folder: Path) -> Iterator[Page]:
    """A page of a new browser whose profile is in a folder."""
    program = browser_path()
    assert program is not None
    port_file = folder / "profile" / "DevToolsActivePort"
    command = [program, *ARGUMENTS, f"--user-data-dir={folder / 'profile'}", "about:blank"]
    with (folder / "browser.log").open("w") as log, subprocess.Popen(command, stdout=log, stderr=log) as process:
        try:
            start = time.monotonic()
            while not (port_file.exists() and port_file.read_text().strip()):
                if process.poll() is not None or time.monotonic() - start > STARTED_WITHIN_S:
                    raise RuntimeError((folder / "browser.log").read_text()[-2000:])
                time.sleep(0.05)
            port = port_file.read_text().split()[0]
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/json", timeout=STARTED_WITHIN_S) as answer:
                pages = [each for each in json.load(answer) if each["type"] == "page"]
            yield Page(pages[0]["webSocketDebuggerUrl"])
        finally:
            process.terminate()


@contextmanager
def served(folder: Path) -> Iterator[str]:
    """The address under which a folder is served."""

    class Quiet(http.server.SimpleHTTPRequestHandler):
        def log_message(self, format: str, *args: Any) -> None:
            pass

    handler = functools.partial(Quiet, directory=str(folder))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        try:
            yield f"http://127.0.0.1:{server.server_address[1]}"
        finally:
            server.shutdown()
