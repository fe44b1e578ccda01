"""A headless Chromium, driven by its DevTools protocol: what a page logs, asks for and shows."""

import base64
import contextlib
import json
import re
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.request import urlopen

import msgspec
import numpy as np
import zstandard

NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome", "chrome-headless-shell")
FLAGS = (
    "--headless=new",
    "--no-sandbox",
    "--hide-scrollbars",
    "--disable-dev-shm-usage",
    "--use-gl=angle",
    "--use-angle=swiftshader",  # WebGL on the CPU
    "--enable-unsafe-swiftshader",
    "--remote-debugging-port=0",
    "--no-first-run",
)
EXECUTABLE = next(filter(None, map(shutil.which, NAMES)), None)


def messages(path: Path, rule: str = "") -> list[tuple[float, dict[str, Any]]]:
    """What a page plays, or of a rule's worlds alone: time [s] and message."""
    text = path.read_text()
    (held,) = re.findall(r'__VISER_EMBED_DATA__="([^"]+)"', text)
    if rule:
        (motions,) = re.findall(r"const motions = (\{.+\}), shown", text)
        held = json.loads(motions)[rule][1]
    packed = base64.b64decode(held)
    plain = zstandard.ZstdDecompressor().decompress(packed[8:])
    size = int.from_bytes(plain[:8], "little")
    scene = msgspec.msgpack.decode(plain[8 : 8 + size])
    buffers = []
    at = 8 + size
    for length in scene["binaryBufferLengths"]:
        at += -at % 8
        buffers.append(plain[at : at + length])
        at += length

    def restore(value: Any) -> Any:
        if isinstance(value, dict):
            marks = [key for key in value if key.startswith("__binary")]
            if marks:
                kind = value.get("dtype", "float32")
                return np.frombuffer(buffers[value[marks[0]]], kind)
            return {key: restore(part) for key, part in value.items()}
        return [restore(part) for part in value] if isinstance(value, list) else value

    return [(time, restore(message)) for time, message in scene["messages"]]


class Tab:
    """A page in the browser.

    Attributes:
        problems: Errors that it logged, and exceptions.
        requests: Addresses that it asked for, without those inside it.
    """

    def __init__(self, socket: Any) -> None:
        self._socket = socket
        self._number = 0
        self.problems: list[str] = []
        self.requests: list[str] = []
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **params: Any) -> dict[str, Any]:
        """Send a command and wait for its answer, taking events on the way."""
        self._number += 1
        self._socket.send(json.dumps({"id": self._number, "method": method, "params": params}))
        while True:
            got = json.loads(self._socket.recv(timeout=120))
            if got.get("id") == self._number:
                assert "error" not in got, got
                return got["result"]
            self._take(got["method"], got["params"])

    def _take(self, method: str, event: dict[str, Any]) -> None:
        if method == "Runtime.consoleAPICalled" and event["type"] in ("error", "assert"):
            self.problems.append(" ".join(str(a.get("value", a)) for a in event["args"]))
        elif method == "Runtime.exceptionThrown":
            self.problems.append(json.dumps(event["exceptionDetails"])[:500])
        elif method == "Log.entryAdded" and event["entry"]["level"] == "error":
            self.problems.append(event["entry"]["text"])
        elif method == "Network.requestWillBeSent":
            address = event["request"]["url"]
            if not address.startswith(("data:", "blob:")):
                self.requests.append(address)

    def open(self, address: str) -> float:
        """Load an address; return how long it took until it was loaded [s]."""
        began = time.perf_counter()
        self.call("Page.navigate", url=address)
        self.wait("document.readyState == 'complete'")
        return time.perf_counter() - began

    def run(self, script: str) -> Any:
        """The value of an expression in the page."""
        return self.call("Runtime.evaluate", expression=script, returnByValue=True)["result"].get(
            "value"
        )

    def wait(self, script: str, seconds: float = 60.0) -> None:
        """Wait until an expression holds."""
        until = time.monotonic() + seconds
        while not self.run(script):
            assert time.monotonic() < until, f"{script} never held; {self.problems}"
            time.sleep(0.1)

    def picture(self) -> bytes:
        """A PNG of what is seen."""
        return base64.b64decode(self.call("Page.captureScreenshot")["data"])


@contextlib.contextmanager
def browse(width: int = 1200, height: int = 800) -> Iterator[Tab]:
    """A tab of a browser that ends with the block."""
    from websockets.sync.client import connect

    assert EXECUTABLE is not None
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as home:
        command = [EXECUTABLE, *FLAGS, f"--user-data-dir={home}"]
        command.append(f"--window-size={width},{height}")
        process = subprocess.Popen(
            [*command, "about:blank"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        try:
            held = Path(home, "DevToolsActivePort")
            until = time.monotonic() + 60.0
            while not (held.exists() and held.read_text().count("\n")):
                assert time.monotonic() < until, "the browser did not start"
                time.sleep(0.05)
            port = held.read_text().split()[0]
            tabs = json.loads(urlopen(f"http://127.0.0.1:{port}/json").read())
            address = next(tab["webSocketDebuggerUrl"] for tab in tabs if tab["type"] == "page")
            with connect(address, max_size=None) as socket:
                yield Tab(socket)
        finally:
            process.terminate()
            process.wait(timeout=30)
