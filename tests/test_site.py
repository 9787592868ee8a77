"""The site of the documents is built without a complaint, and what it says runs."""

import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import makebreak
import makebreak.gap
from makebreak.models.typed_yaml import field_types
from makebreak.scripts.cli.arguments import make_parser, parse
from makebreak.scripts.cli.command_inputs import experiment_module
from makebreak.scripts.experiments import EXPERIMENTS

ROOT = Path(__file__).resolve().parent.parent
DOCS = ROOT / "docs"


def build(folder, *options):
    """Where the site of a copy of the documents is; what was said of it."""
    (root := folder / "root").mkdir()
    for each in ROOT.iterdir():
        if each.is_dir() and each != DOCS:
            (root / each.name).symlink_to(each)
    for each in ROOT.glob("*.md"):  # Their links are from where they are.
        shutil.copy(each, root)
    built = shutil.ignore_patterns("built", "sg_execution_times.rst", "__pycache__")
    shutil.copytree(DOCS, root / "docs", ignore=built)
    words = ["-m", "sphinx", "-q", "-W", "--keep-going", *options]
    done = subprocess.run(
        [sys.executable, *words, str(root / "docs"), str(folder / "site")],
        capture_output=True, text=True,
    )  # fmt: skip
    return folder / "site", done


def test_the_site_has_every_page_and_name_and_needs_no_network(tmp_path):
    """-W: a link or a heading that is not there, a page in no list, is an error."""
    site, done = build(tmp_path, "-D", "plot_gallery=0")
    assert done.returncode == 0, done.stderr
    tutorials = {f"built/{each.stem}" for each in DOCS.glob("tutorials/*.py")}
    pages = {str(p.relative_to(DOCS).with_suffix("")) for p in DOCS.rglob("*.md")}
    home = (site / "index.html").read_text()
    for page in tutorials | pages - {"index"}:
        assert f'href="{page}.html"' in home, page
    reference = (site / "reference.html").read_text()
    for module in (makebreak, makebreak.gap):
        for name in module.__all__:
            assert f'id="{module.__name__}.{name}"' in reference, name
    terms = re.findall(
        r"^\| ([A-Z][\w-]*) \| ([^|]*) \|", (DOCS / "terms.md").read_text(), re.M
    )
    assert len(terms) > 10
    for page in [p for p in pages - {"terms"} if (site / f"{p}.html").is_file()]:
        body = re.search(
            r"<article[\s\S]*?</article>", (site / f"{page}.html").read_text()
        )[0]
        body = re.sub(r"<(pre|code|h\d|title)\b[\s\S]*?</\1>", "", body)
        plain = re.sub(r"<abbr[\s\S]*?</abbr>", "", body)
        for term, meaning in terms:
            said = f'<abbr title="{meaning}">{term}</abbr>'
            used = re.search(rf">[^<]*(?<![\w/-]){term}(?![\w-])", plain)
            assert body.count(said) == 1 if used else body.count(said) <= 1, (
                page,
                term,
            )
    for page in site.rglob("*.html"):
        loaded = re.findall(
            r'<(?:script|link|img)[^>]*(?:src|href)="(.*?)"', page.read_text()
        )
        assert loaded and not [each for each in loaded if "//" in each], page


@pytest.mark.slow  # 40 s: `gap` four times, in processes of their own.
def test_tutorials_say_what_they_promise(tmp_path):
    site, done = build(tmp_path)
    assert done.returncode == 0, done.stderr
    log = (site / "built" / "your_log.html").read_text()
    # 0.3 N m at the elbow; nothing new on Friday; then 0.25 kg, 0.3 m below the elbow.
    said = re.search(r"elbow has Coulomb friction of ([\d.]+) \+- ([\d.]+) N m", log)
    assert abs(float(said[1]) - 0.3) < 3.0 * float(said[2])
    assert "No gap: The scene and the recordings agree" in log
    mass, std = re.search(r"fore carries ([\d.]+) \+- ([\d.]+) kg", log).groups()
    assert abs(float(mass) - 0.25) < 3.0 * float(std)
    plant = (site / "built" / "your_plant.html").read_text()
    right, wrong, learned = re.findall(r"puck ends at ([\d.]+) m", plant)
    assert float(wrong) < 0.48 and {right, learned} <= {"0.499", "0.500", "0.501"}


def commands():
    """(page, words) of each command of makebreak that a page shows."""
    for page in [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *DOCS.rglob("*.md")]:
        text = page.read_text().replace("\\\n", " ")
        for line in re.findall(r"^ +(?:\.venv/bin/)?makebreak (\S.*)$", text, re.M):
            if line.startswith("--"):  # It ends the parser.
                continue
            if not re.search(r"\[|\||\.\.\.", line.partition("  #")[0]):  # No pattern.
                yield page.relative_to(ROOT), shlex.split(line, comments=True)


def test_options_that_documents_show_are_there():
    class Anything(dict):
        def __missing__(self, name):
            return lambda args: 0

    parser, shown = make_parser(Anything()), list(commands())
    assert len(shown) > 80
    for page, words in shown:
        try:
            args = parse(parser, words)
        except ValueError as error:
            pytest.fail(f"{page}: makebreak {shlex.join(words)}: {error}")
        if (name := getattr(args, "experiment", None)) not in EXPERIMENTS:
            continue
        settings = field_types(experiment_module(name).Config)
        for group in (*getattr(args, "set", []), *getattr(args, "vary", [])):
            for setting in group:
                key = setting.partition("=")[0]
                assert key in settings, (page, words)
