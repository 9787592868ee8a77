"""Takes a screenshot of a Meshcat page without a display; needs Debian's chromium.

python -m makebreak.scripts.runner.screenshot runs/<run>/meshcat.html picture.png
python -m makebreak.scripts.runner.screenshot http://localhost:7000 picture.png
"""

import argparse
import shutil
import subprocess
import sys
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory
from time import sleep

from PIL import Image

from makebreak.scripts.runner.browser import Browser, browser_command
from makebreak.scripts.runner.meshcat_page import OPEN_CONTROLS

LIMIT_SEC = 300


def screenshot(page: Path | str, picture: Path, size=(1280, 800), wait_ms: int = 15000):
    """Renders `page` in a headless browser and writes `picture`.

    Args:
        page: an HTML file, or the address of a running Meshcat, whose controls are
            opened.
        picture: the PNG to write.
        size: width and height [pixels].
        wait_ms: time at which it is taken: of a file on the page's own clock, of a
            running Meshcat in real time after it was opened [ms].
    Raises: ValueError without page or browser; RuntimeError if the browser writes no
        picture.
    """
    if str(page).startswith("http://"):
        _of_running(str(page), picture, size, wait_ms)
        return
    if not Path(page).is_file():
        raise ValueError(f'page: got "{page}", expected an HTML file')
    with TemporaryDirectory() as folder:
        taken = Path(folder) / "page.png"
        # The page's own clock waits while meshes and textures are loaded. It would not
        # wait for a socket.
        command = [
            *browser_command(Path(folder), size),
            f"--virtual-time-budget={wait_ms}",
            f"--screenshot={taken}",
            Path(page).resolve().as_uri(),
        ]
        try:
            done = subprocess.run(
                command, capture_output=True, text=True, timeout=LIMIT_SEC
            )
        except subprocess.TimeoutExpired as error:
            raise RuntimeError(f"{command[0]} took more than {LIMIT_SEC} s") from error
        if not taken.is_file():
            lines = done.stderr.strip().splitlines() or ["no output"]
            raise RuntimeError(f"{command[0]} wrote no picture: {lines[-1]}")
        shutil.move(taken, picture)


def moving_picture(
    page: Path, picture: Path, seconds: float, box=(130, 40, 690, 440), size=(960, 640)
) -> None:
    """The animation of a meshcat.html as an animated WebP, at twice its speed.

    Args:
        seconds: how much of it, from its start [s].
        box: what is shown of the page, left, upper, right, lower [pixels].
        size: width and height of the page [pixels].
    Raises: as screenshot.
    """
    with Browser(size, LIMIT_SEC) as browser:
        browser.open(Path(page).resolve().as_uri())
        sleep(6.0)  # Until its meshes are loaded.
        browser.run("viewer.gui.hide(); viewer.animator.pause()")
        frames = []
        for k in range(round(5.0 * seconds)):
            browser.run(_SHOWN_AT % (0.2 * k))
            frames.append(Image.open(BytesIO(browser.screenshot())).crop(box))
    first, *others = [each.convert("RGB").resize((448, 320)) for each in frames]
    first.save(
        picture, save_all=True, append_images=others, duration=100, loop=0, quality=60
    )


# Of the page's animation [s]; kept when that is drawn.
_SHOWN_AT = """viewer.animator.seek(%g), viewer.set_dirty(),
    new Promise((drawn) => requestAnimationFrame(() => requestAnimationFrame(drawn)))"""


def _of_running(address: str, picture: Path, size, wait_ms: int) -> None:
    """As `screenshot`, of a running Meshcat: in real time, since its scene comes
    through a socket."""
    with Browser(size, LIMIT_SEC) as browser:
        browser.open(address)
        browser.run(OPEN_CONTROLS)
        sleep(1e-3 * wait_ms)
        Path(picture).write_bytes(browser.screenshot())


def main() -> int:
    parser = argparse.ArgumentParser(
        description="An image of a meshcat.html or a running Meshcat, without a screen."
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
