"""Pictures and transcripts of the docs, made anew: `make pictures`.

A headless Chromium draws the pictures: of the report page of `tactile-cell run`, and of the
operator's page of `tactile-cell serve` with a named part in the grip.
Transcripts are the output of the commands in the tutorial. The most similar line of a new run
replaces each line in the tutorial.
"""

import difflib
import json
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from PIL import Image, ImageChops
from playwright.sync_api import sync_playwright

from docs.tools.transcript import main as write_transcript

DOCS = Path(__file__).parent.parent
TUTORIAL = DOCS / "tutorials" / "simulated-cell.md"
CUTS = {
    "confusion": "#result .tables",
    "grasp": "#examples .example:first-of-type",
    "shape": "#shapes .shape-rows",
}
"""What each picture shows of the report, as a CSS selector."""
_BROWSER = "chromium"
_WIDTH_PX, _HEIGHT_PX = 1200, 2400
_TOKEN = "the-token-of-the-pictures"
_NAMED_BEFORE = 6
"""Parts that the operator's page shows as named before the one in the grip."""
_WAIT_MS = 300_000
"""Longest wait in ms for what the page shows: a first start teaches five objects."""
_LEAST_ALIKE = 0.5
"""Likeness from 0 to 1 from which a line of today is taken for the one that is shown."""
_NOT_RUN = ("serve", "replay")
"""Commands that run until they are ended."""
_CONSOLE = re.compile(r"(?<=```console\n).*?(?=```)", re.DOTALL)
_NEVER_SHOWN = re.compile("━")
"""Progress bars."""


def main() -> None:
    """Make the pictures, of the report that is named or of a new run, and the transcripts."""
    if len(sys.argv) > 1:
        draw(Path(sys.argv[1]))
    else:
        with tempfile.TemporaryDirectory() as folder:
            subprocess.run([_program(), "run", "--out", folder], check=True)
            draw(next(Path(folder).glob("run-*/report.html")))
    draw_page()
    TUTORIAL.write_text(today(TUTORIAL.read_text(encoding="utf-8")), encoding="utf-8")
    write_transcript()


def draw(report: Path) -> None:
    """Write the pictures of a report."""
    page = report.read_text(encoding="utf-8")
    with tempfile.TemporaryDirectory() as folder:
        for name, selector in CUTS.items():
            # Everything is hidden but the element and what is in it; it is laid over the page.
            cut = (
                f"<style>body *{{visibility:hidden}} {selector},"
                f"{selector} *{{visibility:visible}} {selector}"
                "{position:absolute;left:16px;top:16px;width:1168px;margin:0;z-index:9}</style>"
            )
            source, shot = Path(folder, f"{name}.html"), Path(folder, f"{name}.png")
            source.write_text(page.replace("</head>", f"{cut}</head>"), encoding="utf-8")
            options = ["--headless", "--no-sandbox", "--hide-scrollbars", "--disable-gpu"]
            size = f"--window-size={_WIDTH_PX},{_HEIGHT_PX}"
            subprocess.run(
                [_BROWSER, *options, size, f"--screenshot={shot}", source.as_uri()],
                check=True,
                capture_output=True,
            )
            image = Image.open(shot).convert("RGB")
            empty = Image.new("RGB", image.size, image.getpixel((0, 0)))
            _, _, _, bottom = ImageChops.difference(image, empty).getbbox() or (0, 0, 0, 1)
            image = image.crop((0, 0, _WIDTH_PX, min(bottom + 16, _HEIGHT_PX)))
            image.quantize(256).save(DOCS / "images" / f"{name}.png", optimize=True)


def draw_page() -> None:
    """Write the picture of the operator's page, of a cell that has named parts and holds one."""
    with (
        tempfile.TemporaryDirectory() as folder,
        _served(Path(folder, "token")) as cell,
        sync_playwright() as playwright,
    ):
        try:
            interface = json.loads(cell.stdout.readline()) if cell.stdout else {}
            browser = playwright.chromium.launch(
                executable_path=shutil.which(_BROWSER), args=["--no-sandbox", "--disable-gpu"]
            )
            # Without motion no bar is still on its way.
            page = browser.new_page(
                viewport={"width": 1400, "height": 900}, locale="en-GB", reduced_motion="reduce"
            )
            page.set_default_timeout(_WAIT_MS)
            page.goto(f"http://127.0.0.1:{interface['http_port']}/#token={_TOKEN}")
            page.get_by_text("Nobody is in command").wait_for()
            page.click("#command")
            for number in range(_NAMED_BEFORE + 1):
                if number == _NAMED_BEFORE:
                    page.select_option("#keep", "always")
                page.click("#do_identify[aria-disabled=false]")
                page.wait_for_function(
                    "n => document.querySelectorAll('#strip button').length > n", arg=number
                )
            page.get_by_text("Part held").first.wait_for()
            page.locator("#days .count").first.get_by_text(str(_NAMED_BEFORE + 1)).wait_for()
            shot = DOCS / "images" / "page.png"
            page.screenshot(path=shot)
            Image.open(shot).convert("RGB").quantize(256).save(shot, optimize=True)
            browser.close()
        finally:
            cell.terminate()


def _served(token: Path) -> "subprocess.Popen[str]":
    """Return `tactile-cell serve` at free ports; its token is written to a file."""
    token.write_text(_TOKEN, encoding="utf-8")
    options = ["--http", "0", "--modbus", "0", "--xml-rpc", "0", "--token-file", token]
    return subprocess.Popen([_program(), "serve", *options], stdout=subprocess.PIPE, text=True)


def today(text: str) -> str:
    """Return a page with the transcripts of its commands as they are printed today."""
    with tempfile.TemporaryDirectory() as folder:
        return _CONSOLE.sub(lambda block: "\n".join(_block(block[0], Path(folder))) + "\n", text)


def _block(block: str, folder: Path) -> Iterator[str]:
    printed: list[str] = []
    for line in block.splitlines():
        if line.startswith("$ "):
            yield line
            printed = _printed(line.removeprefix("$ "), folder)
        else:
            yield _like(line, printed) if printed else line


def _printed(command: str, folder: Path) -> list[str]:
    """Return what a command of the program prints; nothing for others, and for endless ones."""
    program, *arguments = shlex.split(command)
    if program != "tactile-cell" or arguments[0] in _NOT_RUN:
        return []
    done = subprocess.run(
        [_program(), *arguments], cwd=folder, capture_output=True, text=True, check=False
    )
    lines = (done.stdout + done.stderr).splitlines()
    return [line for line in lines if not _NEVER_SHOWN.search(line)]


def _like(wanted: str, printed: list[str]) -> str:
    """Return the printed line that is most similar to the shown line, shortened like it."""
    start, short, _ = wanted.partition(" ...")
    ratio, line = max(
        (difflib.SequenceMatcher(None, start, line[: len(start)] if short else line).ratio(), line)
        for line in printed
    )
    if ratio < _LEAST_ALIKE:
        raise SystemExit(f"no longer printed: {wanted!r}; correct the page, then make it again")
    return " ".join(line.split(" ")[: len(start.split(" "))]) + short if short else line


def _program() -> Path:
    return Path(sys.executable).with_name("tactile-cell")


if __name__ == "__main__":
    main()
