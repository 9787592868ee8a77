"""Takes a screenshot of a meshcat.html without a display; needs Debian's chromium.

python -m makebreak.scripts.screenshot runs/<run>/meshcat.html picture.png
"""

import argparse
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from tempfile import TemporaryDirectory
from threading import Thread
from time import sleep
from urllib.request import urlopen

from makebreak.scripts.meshcat_page import with_controls

LIMIT_SEC = 600
CONNECTS_SEC = 10.0  # So long a page that runs may take to get its scene.
_BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")


class _Slow(BaseHTTPRequestHandler):
    """Answers late: a browser's own clock stands still while an image is on its way,
    but not while a socket's messages are."""

    def do_GET(self):
        sleep(CONNECTS_SEC)
        self.send_error(404)

    def log_message(self, *_):
        pass


@contextmanager
def slow_server() -> Iterator[str]:
    """While entered, the address of an image that comes late."""
    server = ThreadingHTTPServer(("localhost", 0), _Slow)
    Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://localhost:{server.server_port}/late.png"
    finally:
        server.shutdown()
        server.server_close()


def live_page(address: str, late: str) -> str:
    """The page of a Meshcat that runs, with its controls open; it connects to it.

    Args: late: the address of an image that comes when the scene is there.
    """
    base = address.rstrip("/") + "/"
    with urlopen(base) as answer:
        page = answer.read().decode()
    page = page.replace("url = location.toString();", f'url = "{base}";')
    page = page.replace("<head>", f'<head><base href="{base}">', 1)
    image = f'<img src="{late}" hidden>'
    return with_controls(page.replace("</body>", f"{image}</body>"))


def screenshot(page: Path | str, picture: Path, size=(1280, 800), wait_ms: int = 15000):
    """Renders `page` in a headless browser and writes `picture`.

    Args:
        page: an HTML file, or an address such as that of a running Meshcat.
        picture: the PNG to write.
        size: width and height [pixels].
        wait_ms: time at which it is taken, on the page's own clock [ms].
    Raises: ValueError without page or browser; RuntimeError if the browser writes no
        picture.
    """
    live = str(page).startswith("http://")
    if not live and not Path(page).is_file():
        raise ValueError(f'page: got "{page}", expected an HTML file')
    browser = next(filter(None, map(shutil.which, _BROWSERS)), None)
    if browser is None:
        raise ValueError("no browser found, expected one of: " + ", ".join(_BROWSERS))
    with TemporaryDirectory() as folder, slow_server() as late:
        profile, taken = Path(folder) / "profile", Path(folder) / "page.png"
        file = Path(folder) / "page.html" if live else Path(page).resolve()
        if live:
            file.write_text(live_page(str(page), late))
        options = [
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
            f"--user-data-dir={profile}",
            f"--window-size={size[0]},{size[1]}",
            f"--virtual-time-budget={wait_ms}",
            f"--screenshot={taken}",
            file.as_uri(),
        ]
        if live:  # Else Meshcat's textures are black: they are of another origin.
            options.insert(0, "--disable-web-security")
        try:
            done = subprocess.run(
                [browser, *options], capture_output=True, text=True, timeout=LIMIT_SEC
            )
        except subprocess.TimeoutExpired as error:
            raise RuntimeError(f"{browser} took more than {LIMIT_SEC} s") from error
        if not taken.is_file():
            lines = done.stderr.strip().splitlines() or ["no output"]
            raise RuntimeError(f"{browser} wrote no picture: {lines[-1]}")
        shutil.move(taken, picture)


def main() -> int:
    parser = argparse.ArgumentParser(
        description="A picture of a meshcat.html, taken without a screen."
    )
    parser.add_argument("page", help="an HTML file, or http://...")
    parser.add_argument("picture", type=Path)
    args = parser.parse_args()
    try:
        screenshot(args.page, args.picture)
    except (ValueError, RuntimeError) as error:
        print(f"screenshot: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
