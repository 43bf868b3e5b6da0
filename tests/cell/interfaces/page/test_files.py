"""The files of the page: how they are served, their size, and each text in each language."""

import json
import re
from http.client import HTTPConnection
from typing import Any, get_args

import pytest

from cell.control.states import CellState, GraspState
from cell.fault_catalogue import CATALOGUE, RecoveryStep
from cell.interfaces.http_server import REMEDIES
from cell.interfaces.page import FOLDER
from cell.runtime.goals import TASKS
from recognition.shape.answer import UNCLEAR
from recognition.shape.models import SHAPE_MODELS
from simulator.faults.vocabulary import VOCABULARY

WORDS = {path.stem: json.loads(path.read_text()) for path in FOLDER.glob("??.json")}
SOURCE = "\n".join(path.read_text() for path in FOLDER.glob("*.js"))
HTML = "\n".join(path.read_text() for path in FOLDER.glob("*.html"))
FAMILIES: dict[str, set[str]] = {
    "state.": {*CellState, "away"},
    "grip.": set(GraspState),
    "task.": {"gauge", "shutdown", "forget", "forget_drift", "simulation_reset"},
    "step.": set(get_args(RecoveryStep)),
    "shape.": {*SHAPE_MODELS, UNCLEAR},
    "why.state.": set(CellState),
    "why.only.": {"verify", "clear", "reset"},
    "do.": {*TASKS, "release", "clear", "clear_reboot", "reset"},
    "ended.": {"SUCCEEDED", "CANCELED", "ABORTED"},
    "teach.": {"CANCELED", "ABORTED"},
    "kind.": {"sure", "unsure", "unknown"},
    "level.": {"watch", "bad"},
}
REPORTED = {f"{prefix}{name}" for prefix, names in FAMILIES.items() for name in names}
"""Keys that end with what the cell reports."""


def used() -> set[str]:
    """Return the keys that the page asks for by their whole name."""
    keys = set(re.findall(r'data-t="([^"]+)"', HTML))
    return keys.union(re.findall(r'["`]([a-z_]+(?:\.[A-Za-z_]+)+)["`]', SOURCE))


def texts(language: str) -> dict[str, str]:
    return {key: text for key, text in WORDS[language].items() if isinstance(text, str)}


def all_keys() -> set[str]:
    """Return the keys; those of one and of several are one."""
    english = texts("en")
    both = {key.removesuffix(".one") for key in english if key.endswith(".one")}
    return {key for key in english if key.rpartition(".")[0] not in both} | both


@pytest.mark.parametrize("language", sorted(WORDS))
def test_a_language_has_the_keys_and_places_of_english(language: str) -> None:
    english, translated = texts("en"), texts(language)
    assert translated.keys() == english.keys()
    for key, text in english.items():
        assert text.strip()
        assert translated[key].strip()
        wanted = set(re.findall(r"\{(\w+)\}", text)) - {"n"}
        assert set(re.findall(r"\{(\w+)\}", translated[key])) - {"n"} == wanted, key


def test_the_page_asks_for_no_text_that_is_missing() -> None:
    keys = all_keys()
    asked = used() - {path.name for path in FOLDER.iterdir()}
    prefixes = {key.partition(".")[0] for key in keys}
    assert {key for key in asked if key.partition(".")[0] in prefixes} - keys == set()
    assert REPORTED - keys == set()


def test_no_text_is_unused() -> None:
    keys = all_keys()
    # Keys that a template ends, as t(`shift.${key}`), with the names in the same file.
    made = {
        f"{prefix}{name}"
        for path in FOLDER.glob("*.js")
        for prefix in re.findall(r"`([a-z_]+\.)\$\{", path.read_text())
        for name in re.findall(r'"([A-Za-z_]+)"', path.read_text())
    }
    assert keys - used() - REPORTED - made == set()


def test_german_has_each_fixed_text_of_the_server_and_no_other() -> None:
    german, entries = WORDS["de"], CATALOGUE.values()
    assert set(german["faults"]) == {str(fault.number) for fault in entries}
    fixed = {text for one in entries for text in (one.cause, one.remedy, one.grip)}
    assert set(german["exact"]) == fixed | set(REMEDIES.values())
    assert set(german["simulated"]) == set(VOCABULARY)
    pairs = [(fault.text, german["faults"][str(fault.number)]) for fault in entries]
    for english, text in (*pairs, *german["exact"].items()):
        assert text.strip()
        assert text != english
        # Keys of the config and commands stand in both as they are.
        assert re.findall(r"`[^`]+`", text) == re.findall(r"`[^`]+`", english), english


def test_the_files_together_are_small_and_the_page_uses_each() -> None:
    used, waiting = set(FOLDER.glob("*.json")), [FOLDER / "index.html"]
    while waiting:
        path = waiting.pop()
        used.add(path)
        if path.suffix in (".html", ".js"):
            named = re.findall(r'"(?:\./|page/)?([\w-]+\.(?:js|css|svg))"', path.read_text())
            waiting += {FOLDER / name for name in named} - used
    assert used == set(FOLDER.iterdir())
    assert sum(path.stat().st_size for path in used) <= 250_000


def test_nothing_is_written_as_html_and_nothing_comes_from_elsewhere() -> None:
    assert not re.search(r"innerHTML|outerHTML|insertAdjacent|document\.write|\beval\(", SOURCE)
    assert "style=" not in HTML
    assert "showModal" not in SOURCE  # a modal dialog would be in front of Hold
    assert not re.search(r"\son[a-z]+=", HTML)
    for text in (SOURCE, HTML, (FOLDER / "style.css").read_text()):
        assert set(re.findall(r"https?://[\w./]+", text)) <= {"http://www.w3.org/2000/svg"}


def test_files_are_served_without_token_and_with_their_headers(serve: Any) -> None:
    link = HTTPConnection("127.0.0.1", serve("http").interfaces["http_port"], timeout=20.0)

    def ask(path: str, **headers: str) -> Any:
        link.request("GET", path, headers=headers)
        answer = link.getresponse()
        answer.read()
        return answer

    for path, kind in (
        ("/", "text/html"),
        ("/page/main.js", "javascript"),
        ("/page/de.json", "json"),
    ):
        answer = ask(path)
        assert answer.status == 200
        assert kind in answer.headers["Content-Type"]
        assert "unsafe" not in answer.headers["Content-Security-Policy"]
        assert "default-src 'none'" in answer.headers["Content-Security-Policy"]
        assert answer.headers["X-Content-Type-Options"] == "nosniff"
        assert answer.headers["Cache-Control"] == "no-cache"
        # What the browser has is asked for, and not sent again.
        known = ask(path, **{"If-None-Match": answer.headers["ETag"]})
        assert known.status == (200 if path == "/" else 304)
        assert known.headers["Cache-Control"] == "no-cache"
    for path in ("/page/../__init__.py", "/page/%2e%2e/__init__.py", "/page/", "/page/nothing.js"):
        assert ask(path).status == 404, path
    assert ask("/", Host="evil.example").status == 403
    link.close()
