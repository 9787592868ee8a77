"""A headless browser that is driven over its DevTools protocol, through two pipes."""

import base64
import json
import os
import select
import shutil
import subprocess
from pathlib import Path
from tempfile import TemporaryDirectory
from time import monotonic

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")
_OPTIONS = (
    "--headless=new",
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    "--disable-quic",
    "--hide-scrollbars",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
)
_LOADED = """new Promise((loaded) => {
    if (document.readyState == "complete") loaded();
    else addEventListener("load", () => loaded());
})"""


def browser_command(folder: Path, size: tuple[int, int]) -> list[str]:
    """The command of a headless browser, without a page.

    Args: folder: for its profile; size: of its window, width and height [pixels].
    Raises: ValueError without a browser.
    """
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        raise ValueError("no browser found, expected one of: " + ", ".join(BROWSERS))
    window = f"--window-size={size[0]},{size[1]}"
    return [browser, *_OPTIONS, f"--user-data-dir={folder / 'profile'}", window]


class Browser:
    """A headless browser with one page, whose clock is real time. For a `with`.

    Args: size: of the page [pixels]; limit_sec: the longest wait for an answer.
    Raises: ValueError without a browser.

    Source: Chrome DevTools Protocol, with --remote-debugging-pipe: the browser reads
        JSON from its file 3 and writes to its file 4, each message with a zero byte
        at its end.
    """

    def __init__(self, size: tuple[int, int] = (1280, 800), limit_sec: float = 300.0):
        self._size, self._limit = size, limit_sec
        self._folder = TemporaryDirectory()
        try:
            self._command = browser_command(Path(self._folder.name), size)
        except ValueError:
            self._folder.cleanup()
            raise
        self._sent, self._unread = 0, b""

    def __enter__(self):
        reads, self._to = os.pipe()
        self._from, writes = os.pipe()
        # Python cannot give a file another number in the child; bash can.
        moved = f'exec "$@" 3<&{reads} 4>&{writes}'
        self._process = subprocess.Popen(
            ["bash", "-c", moved, "bash", *self._command, "--remote-debugging-pipe"],
            pass_fds=(reads, writes),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(reads)
        os.close(writes)
        try:
            pages = self._ask("Target.getTargets", {})["targetInfos"]
            page = next(p["targetId"] for p in pages if p["type"] == "page")
            attach = {"targetId": page, "flatten": True}
            self._session = self._ask("Target.attachToTarget", attach)["sessionId"]
            width, height = self._size  # A window is less high by its title.
            self.ask(
                "Emulation.setDeviceMetricsOverride",
                width=width, height=height, deviceScaleFactor=1, mobile=False,
            )  # fmt: skip
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_):
        os.close(self._to)  # The browser ends when its input does.
        try:
            self._process.wait(10.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        os.close(self._from)
        self._folder.cleanup()

    def ask(self, method: str, **parameters) -> dict:
        """Calls a method of the page. Returns: its result.

        Raises: RuntimeError if the browser refuses it, ends, or does not answer.
        """
        return self._ask(method, parameters, {"sessionId": self._session})

    def open(self, address: str) -> None:
        """Loads the page at the address. Raises: RuntimeError if there is none."""
        error = self.ask("Page.navigate", url=address).get("errorText")
        if error:
            raise RuntimeError(f"{address}: {error}")
        self.run(_LOADED)

    def run(self, script: str):
        """The value of a JavaScript expression, of a promise when it is kept.

        Raises: RuntimeError if it fails.
        """
        answer = self.ask(
            "Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True
        )
        if "exceptionDetails" in answer:
            raise RuntimeError(f"{script}: {answer['exceptionDetails']['text']}")
        return answer["result"].get("value")

    def screenshot(self) -> bytes:
        """What the page shows, as a PNG."""
        return base64.b64decode(self.ask("Page.captureScreenshot")["data"])

    def _ask(self, method: str, parameters: dict, more: dict | None = None) -> dict:
        self._sent += 1
        message = {"id": self._sent, "method": method, "params": parameters}
        try:
            os.write(self._to, json.dumps(message | (more or {})).encode() + b"\0")
        except BrokenPipeError as error:
            raise RuntimeError(f"{self._command[0]} ended") from error
        end = monotonic() + self._limit
        while True:
            answer = self._next(end)
            if answer.get("id") == self._sent:  # Else an event.
                break
        if "error" in answer:
            raise RuntimeError(f"{method}: {answer['error']['message']}")
        return answer["result"]

    def _next(self, end: float) -> dict:
        """The next message, which must come before the time `end`."""
        while b"\0" not in self._unread:
            if not select.select([self._from], [], [], max(end - monotonic(), 0.0))[0]:
                limit = f"{self._limit:g} s"
                raise RuntimeError(f"{self._command[0]} took more than {limit}")
            came = os.read(self._from, 1 << 16)
            if not came:
                raise RuntimeError(f"{self._command[0]} ended")
            self._unread += came
        message, self._unread = self._unread.split(b"\0", 1)
        return json.loads(message)
