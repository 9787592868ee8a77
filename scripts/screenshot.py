"""An image of a meshcat.html, taken without a screen: needs Debian's chromium.

python -m makebreak.scripts.screenshot runs/<run>/meshcat.html picture.png
"""

import argparse
import shutil
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from urllib.request import urlopen

from makebreak.scripts.meshcat_page import with_controls

LIMIT_SEC = 300
_BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")


def live_page(address: str) -> str:
    """The page of a Meshcat that runs, with its controls open; it connects to it."""
    base = address.rstrip("/") + "/"
    with urlopen(base) as answer:
        page = answer.read().decode()
    page = page.replace("url = location.toString();", f'url = "{base}";')
    return with_controls(page.replace("<head>", f'<head><base href="{base}">', 1))


def screenshot(page: Path | str, picture: Path, size=(1280, 800), wait_ms: int = 15000):
    """Draws `page` with a browser's software renderer and writes `picture`.

    Args:
        page: an HTML file, or the address of one, as of a Meshcat that runs.
        picture: the PNG to write.
        size: width and height [pixels].
        wait_ms: how long the page may take, on its own clock [ms].
    Raises: ValueError if there is no page or no browser; RuntimeError if the browser
        writes no picture.
    """
    live = str(page).startswith("http://")
    if not live and not Path(page).is_file():
        raise ValueError(f'page: got "{page}", expected an HTML file')
    browser = next(filter(None, map(shutil.which, _BROWSERS)), None)
    if browser is None:
        raise ValueError("no browser found, expected one of: " + ", ".join(_BROWSERS))
    with TemporaryDirectory() as folder:
        profile, taken = Path(folder) / "profile", Path(folder) / "page.png"
        file = Path(folder) / "page.html" if live else Path(page).resolve()
        if live:
            file.write_text(live_page(str(page)))
        options = [
            "--headless=new",
            "--no-sandbox",
            "--use-angle=swiftshader",
            "--enable-unsafe-swiftshader",
            "--ignore-gpu-blocklist",
            "--disable-quic",
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
