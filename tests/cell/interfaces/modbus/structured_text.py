"""Runs the example's function block: its Structured Text, line by line, as Python."""

import re
from pathlib import Path
from typing import Any

BLOCK = Path(__file__).parents[4] / "docs" / "examples" / "tactile_cell.st"


class Uint(int):
    """A UINT: a number, and no string of bits."""

    def __and__(self, other: object) -> Any:
        raise TypeError("AND of a UINT: strict compilers take BOOL and bit strings alone")


class Word(int):
    """A WORD: a string of bits, compared with its like alone."""

    def __and__(self, other: object) -> "Word":
        assert isinstance(other, Word), other
        return Word(int(self) & int(other))

    def __ne__(self, other: object) -> bool:
        assert isinstance(other, Word), other
        return int(self) != int(other)

    __hash__ = None  # type: ignore[assignment]


_TYPES: dict[str, type] = {"BOOL": bool, "UINT": int, "WORD": Word}


def _expression(text: str) -> str:
    """Return an expression of Structured Text as one of Python."""
    text = text.replace("AND WORD#", "& WORD#").replace("UINT_TO_WORD(", "Word(")
    text = re.sub(r"WORD#16#([0-9A-Fa-f]+)", r"Word(0x\1)", text)
    text = re.sub(r"16#([0-9A-Fa-f]+)", r"0x\1", text)
    text = re.sub(r"(?<![<>:])=", "==", text).replace("<>", "!=")
    for word, python in (
        ("AND", "and"),
        ("OR", "or"),
        ("NOT", "not"),
        ("TRUE", "True"),
        ("FALSE", "False"),
    ):
        text = re.sub(rf"\b{word}\b", python, text)
    return text


def _names(text: str, names: set[str]) -> str:
    return re.sub(
        r"\b(EdgeExecute\.Q|\w+)\b",
        lambda found: f"me[{found[1]!r}]" if found[1] in names else found[1],
        text,
    )


class FunctionBlock:
    """The block as a PLC holds it: call it once a cycle; variables by name."""

    def __init__(self) -> None:
        text = re.sub(r"\(\*.*?\*\)", "", BLOCK.read_text(), flags=re.S)
        head, body = text.split("VAR_INPUT", 1)[1].rsplit("END_VAR", 1)
        self.values: dict[str, Any] = {"EdgeExecute.Q": False}
        self._types: dict[str, type] = {}
        self._sizes: dict[str, int] = {}
        for name, kind in re.findall(r"(\w+)\s*:\s*([^;]+);", head):
            size = re.match(r"ARRAY\[0\.\.(\d+)\]", kind)
            if size:
                self._sizes[name] = int(size[1]) + 1
                self.values[name] = [0] * self._sizes[name]
            elif kind in _TYPES:
                self._types[name] = _TYPES[kind]
                self.values[name] = _TYPES[kind]()
        self._last = False
        self._code = compile(self._python(body.split("END_FUNCTION_BLOCK")[0]), str(BLOCK), "exec")

    def __getitem__(self, name: str) -> Any:
        return self.values[name]

    def call(self, **inputs: Any) -> list[int]:
        """Run one cycle and return what it writes."""
        unknown = set(inputs) - set(self.values)
        assert not unknown, unknown
        self.values |= inputs
        for name in ("Inputs", "Part"):
            self.values[name] = [Uint(value) for value in self.values[name]]
            assert len(self.values[name]) == self._sizes[name], name
        exec(self._code, {"me": self.values, "edge": self._edge, "Word": Word})
        for name, kind in self._types.items():
            assert isinstance(self.values[name], kind), name
            assert isinstance(self.values[name], bool) is (kind is bool), name
            assert 0 <= self.values[name] <= 0xFFFF, name
        assert all(0 <= value <= 0xFFFF for value in self.values["Outputs"])
        return list(self.values["Outputs"])

    def _edge(self) -> None:
        now = self.values["Execute"]
        self.values["EdgeExecute.Q"] = now and not self._last
        self._last = now

    def _python(self, body: str) -> str:
        """Return the statements as Python; what is not understood is an error."""
        names = set(self.values)
        flat = re.sub(r"\s+", " ", body)
        flat = re.sub(r"\b(THEN|OF|ELSE|\d+:)(?= )", r"\1;", flat)
        out, depth, first = [], 0, False
        for statement in (one.strip() for one in flat.split(";")):
            line, before, after = statement, 0, 0
            if not statement:
                continue
            if found := re.fullmatch(r"(IF|ELSIF) (.*) THEN", statement):
                word, inside = ("if", 0) if found[1] == "IF" else ("elif", 1)
                before, after = -inside, 1
                line = f"{word} {_names(_expression(found[2]), names)}:"
            elif statement == "ELSE":
                before, after, line = -1, 1, "else:"
            elif found := re.fullmatch(r"CASE (\w+) OF", statement):
                line, after, first = f"match me[{found[1]!r}]:", 1, True
            elif found := re.fullmatch(r"(\d+):", statement):
                before, after, line, first = (0 if first else -1), 1, f"case {found[1]}:", False
            elif statement == "END_IF":
                depth -= 1
                continue
            elif statement == "END_CASE":
                depth -= 2
                continue
            elif statement.startswith("EdgeExecute("):
                line = "edge()"
            else:
                target, _, value = statement.partition(":=")
                assert value, statement
                line = (
                    f"{_names(target.strip(), names)} = {_names(_expression(value.strip()), names)}"
                )
            # A step of CASE ends where the next one begins.
            depth += before
            out.append("    " * depth + line)
            depth += after
        return "\n".join(out)
