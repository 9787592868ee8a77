"""Takes a screenshot of a meshcat.html without a display; needs Debian's chromium.

python -m makebreak.scripts.screenshot runs/<run>/meshcat.html picture.png
"""

import argparse
import shutil
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

LIMIT_SEC = 300
_BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")


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
    address = str(page)
    if not address.startswith("http://"):
        if not Path(page).is_file():
            raise ValueError(f'page: got "{page}", expected an HTML file')
        address = Path(page).resolve().as_uri()
    browser = next(filter(None, map(shutil.which, _BROWSERS)), None)
    if browser is None:
        raise ValueError("no browser found, expected one of: " + ", ".join(_BROWSERS))
    with TemporaryDirectory() as folder:
        profile, taken = Path(folder) / "profile", Path(folder) / "page.png"
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
            address,
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
