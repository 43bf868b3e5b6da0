"""YAML 1.2 of config files: its values, its places, and errors with a remedy."""

import re
from typing import Any, Final

from ruamel.yaml import YAML
from ruamel.yaml.constructor import SafeConstructor
from ruamel.yaml.error import MarkedYAMLError, StreamMark, YAMLError
from ruamel.yaml.nodes import Node
from ruamel.yaml.reader import ReaderError
from ruamel.yaml.scanner import Scanner, ScannerError

from cell.errors import ConfigError

_TAG = "tag:yaml.org,2002:"
_PLAIN_TAGS = ("null", "bool", "int", "float", "str", "seq", "map")
"""Tags of the values that JSON has too."""
_QUOTES = "put the value in quotes"
_REMEDIES: Final = (
    (r"in the indent", "the indent has a tab; use spaces"),
    (r"quoted$", "the closing quote is missing on this line"),
    (r"directive", "only `%YAML 1.2` is read; remove the line that begins with %"),
    (r"single document", "a config is one document; remove the line with ---"),
    (r"duplicate key (.*?) with", r"the key \1 is written twice; remove one of the two"),
    (r"escape", "a backslash between double quotes; use single quotes"),
    (r"colon|unexpected ':'", f"a colon within a value; {_QUOTES}"),
    (r"character (.*) that cannot", rf"a value cannot begin with \1; {_QUOTES}"),
    (r"alias|anchor|tag", rf"* & and ! have a meaning in YAML; {_QUOTES}"),
    (r"flow", "this bracket is not closed, or a comma or a colon is missing in it"),
    (r"simple key", "a colon and a space are missing after the key; write `key: value`"),
    (r"found '<scalar>'", "text after the end of the value; put the whole value in quotes"),
    (
        r"found '<block|found '-'|document start",
        "the indent fits no line above; keys of one section have the same indent",
    ),
    (r"but found '(.)'", r"\1 is not expected here; remove it"),
)
"""Texts of the YAML reader by pattern, the first that matches, and what the operator reads."""


class _Scanner(Scanner):
    """Scanner that takes tabs between values, and keeps where texts begin."""

    open_quote: StreamMark | None = None
    """Beginning of the last text in quotes that does not end on its line."""
    begin: StreamMark | None = None
    """Beginning of the last text without quotes."""

    def scan_to_next_token(self) -> None:
        tab = None
        while True:
            super().scan_to_next_token()
            if self.reader.peek() != "\t":
                break
            tab = self.reader.get_mark()
            self.reader.forward()
        if tab and tab.line == self.reader.line and self.allow_simple_key:
            raise ScannerError(None, None, "tab in the indent", tab)

    def scan_directive(self) -> Any:
        token = super().scan_directive()
        if (token.name, token.value) != ("YAML", (1, 2)):
            raise ScannerError(None, None, "directive", token.start_mark)
        return token

    def scan_flow_scalar(self, style: Any) -> Any:
        before, self.open_quote = self.open_quote, self.reader.get_mark()
        token = super().scan_flow_scalar(style)
        if token.end_mark.line == token.start_mark.line:
            self.open_quote = before
        return token

    def scan_plain(self) -> Any:
        self.begin = self.reader.get_mark()
        return super().scan_plain()


class _Constructor(SafeConstructor):
    """Values of JSON only; a date is a text."""

    yaml_constructors = {  # noqa: RUF012
        **{_TAG + tag: SafeConstructor.yaml_constructors[_TAG + tag] for tag in _PLAIN_TAGS},
        _TAG + "timestamp": SafeConstructor.construct_yaml_str,
        None: SafeConstructor.construct_undefined,
    }


def read_yaml(text: str, source: str) -> tuple[Node | None, Any]:
    """Return the nodes, which have places, and the values of a text.

    Raises ConfigError with ``source``, line and column if the text is not YAML 1.2.
    """
    reader = YAML(typ="safe", pure=True)
    reader.Scanner, reader.Constructor = _Scanner, _Constructor
    try:
        return reader.compose(text), reader.load(text)
    except MarkedYAMLError as error:
        mark, remedy = _remedy(error, reader.scanner, text.splitlines())
        place = f"{source}:{place_of(mark)}" if mark else source
        raise ConfigError(f"{place}: not YAML 1.2: {remedy}") from error
    except ReaderError as error:
        before = text[: error.position]
        line, column = before.count("\n") + 1, len(before) - before.rfind("\n")
        raise ConfigError(
            f"{source}:{line}:{column}: not YAML 1.2: this character is not allowed; remove it, "
            "or save the file as UTF-8"
        ) from error
    except (YAMLError, ValueError, RecursionError) as error:
        raise ConfigError(f"{source}: not YAML 1.2: {error}") from error


def place_of(mark: StreamMark) -> str:
    """Return line and column, both from 1."""
    return f"{mark.line + 1}:{mark.column + 1}"


def _remedy(
    error: MarkedYAMLError, scanner: _Scanner, lines: list[str]
) -> tuple[StreamMark | None, str]:
    """Return the place that is to be corrected, and a sentence for the operator."""
    said = f"{error.context or ''}: {error.problem}".removeprefix(": ")
    mark = error.problem_mark or error.context_mark
    begin = scanner.begin
    if scanner.open_quote and "escape" not in said:
        mark, said = scanner.open_quote, "quoted"
    elif re.search("flow|simple key", said):
        mark = error.context_mark or mark
    elif "mapping values" in said and mark and begin and begin.line == mark.line:
        mark, said = begin, "colon"
    elif "mapping values" in said and mark and begin:
        if lines[begin.line][: begin.column].strip(" -"):
            column = len(lines[mark.line]) - len(lines[mark.line].lstrip())
            mark, said = StreamMark(None, mark.index, mark.line, column), "found '-'"
        else:
            mark, said = begin, "simple key"
    found = ((re.search(pattern, said), remedy) for pattern, remedy in _REMEDIES)
    return mark, next((match.expand(remedy) for match, remedy in found if match), said)
