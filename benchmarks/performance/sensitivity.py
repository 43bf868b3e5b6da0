"""Effect of each constant of `gripper.force`, a third smaller and a third larger.

Each run is its own process, in which one constant has another value from the import on, as have the
values calculated from it. The figures are those of `force_ramps` (torque constant 10 % above and
friction 15 % below the catalogue) and of `touch`, on parts of three stiffnesses. A range without a
changed figure is wide enough for this plant. A constant without effect here may still be needed for
other cases.

``python -m benchmarks.performance.sensitivity --page`` writes all constants, with their origin and
changed figures, into docs/reference/force-constants.md. It takes an hour on two processors. With
``--only`` the other rows keep their figures.
"""

import argparse
import ast
import json
import math
import os
import re
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from importlib.machinery import ModuleSpec, PathFinder, SourceFileLoader
from pathlib import Path
from types import CodeType
from typing import Any

from benchmarks._measure import line, repeats

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "reference" / "force-constants.md"
FACTORS = (2.0 / 3.0, 4.0 / 3.0)
ORIGINS = {
    "tuned": "chosen by trials on the simulated gripper",
    "chosen": "a decision that no measurement can make, such as how long to wait",
    "assumed": "a property of servos, pads or parts that nobody has measured here",
    "resolution": "the smallest step of a register or sensor",
    "statistics": "the rate of false alarms, or a law of averages",
    "computed": "from other constants",
}
"""Origin of a constant -> meaning. The last word of a constant's text names the origin."""
TRIED = ("tuned", "assumed")
"""Origins whose constants are changed."""
_HEAD = """# Constants of the force loop

Written by `python -m benchmarks.performance.sensitivity --page`. The tables have each constant of
`gripper/force` with its value, meaning and origin. Values without a unit in the text are shares or
counts. The last two columns show the figures that change when a tuned or assumed constant is a
third smaller or larger. The figures come from `benchmarks force_ramps` and `benchmarks touch`.
The ramps have 10 N/s and more.
The simulated grippers of the first have ideal gearing, or load-dependent friction, backlash, ripple
and creep (further truths), or the measured gearing of an MX-64. "-" means that no figure changed.
The constant may still be needed for a case that these figures do not cover.

Origins:
"""
_MOVED_SHARE, _MOVED_N, _MOVED_COUNT = 0.25, 0.05, 2
"""Least change of a mean or a time, as a share, of a force in N, and of a number of ramps. The mean
error of a few ramps changes by less without a cause."""
_TIMEOUT_S = 900.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Constant:
    """A number of the force loop, as in its source."""

    module: str
    name: str
    value: str
    text: str
    origin: str

    @property
    def key(self) -> str:
        """Name with the module, without the package."""
        return f"{self.module.removeprefix('gripper.force.')}.{self.name}"


def constants() -> list[Constant]:
    """Return all constants of `gripper.force` that have numbers."""
    found = []
    for path in sorted((ROOT / "gripper" / "force").rglob("*.py")):
        module = ".".join(path.relative_to(ROOT).with_suffix("").parts)
        body = ast.parse(path.read_text(encoding="utf-8")).body
        for node, after in zip(body, [*body[1:], ast.Pass()], strict=True):
            for name, value in _assigned(node):
                text = " ".join(_text(after).split())
                tag = re.search(r" ?\[(\w+)\]$", text)
                names = any(isinstance(one, ast.Name) for one in ast.walk(value))
                origin = tag[1] if tag else "computed" if names else ""
                if _has_number(value):
                    found.append(
                        Constant(
                            module=module,
                            name=name,
                            value=ast.unparse(value),
                            text=text.removesuffix(tag[0]) if tag else text,
                            origin=origin,
                        )
                    )
    return found


def _assigned(node: ast.stmt) -> Iterator[tuple[str, ast.expr]]:
    """Return the names of constants that a statement assigns, with their values."""
    if not isinstance(node, ast.Assign):
        return
    target, value = node.targets[0], node.value
    pairs = [(target, value)]
    if isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple):
        pairs = list(zip(target.elts, value.elts, strict=True))
    for one, its in pairs:
        if isinstance(one, ast.Name) and one.id.isupper():
            yield one.id, its


def _text(node: ast.stmt) -> str:
    is_text = isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
    return str(node.value.value) if is_text else ""  # type: ignore[attr-defined]


def _has_number(value: ast.expr) -> bool:
    if any(isinstance(one, ast.Lambda | ast.JoinedStr) for one in ast.walk(value)):
        return False
    return any(_is_number(one) for one in ast.walk(value)) or isinstance(value, ast.Name)


def _is_number(node: ast.AST) -> bool:
    return (
        isinstance(node, ast.Constant)
        and isinstance(node.value, int | float)
        and not isinstance(node.value, bool)
    )


# -- one run -----------------------------------------------------------------------------------


class Scaled(SourceFileLoader):
    """Loader of a module with another value of one constant."""

    def __init__(self, module: str, path: str, name: str, factor: float) -> None:
        super().__init__(module, path)
        self._scaled = name, factor

    def get_code(self, fullname: str) -> CodeType:
        """Return the code of the module with the other value; a cached one has the old value."""
        name, factor = self._scaled
        tree = ast.parse(self.get_data(self.path))
        for node in tree.body:
            for found, value in _assigned(node):
                if found == name:
                    _scale(node, value, factor)
        return compile(ast.fix_missing_locations(tree), self.path, "exec")


def _scale(node: ast.stmt, value: ast.expr, factor: float) -> None:
    """Multiply a value, or each number of a mapping; a whole number changes by 1 at least."""
    wanted = [value]
    if isinstance(value, ast.Dict | ast.Tuple):
        wanted = list(value.values if isinstance(value, ast.Dict) else value.elts)

    class Multiply(ast.NodeTransformer):
        def visit(self, one: ast.AST) -> Any:
            if not any(one is wish for wish in wanted):
                return self.generic_visit(one)
            if _is_number(one) and isinstance(one.value, int):  # type: ignore[attr-defined]
                was = one.value  # type: ignore[attr-defined]
                step = 1 if factor > 1.0 else -1
                return ast.Constant(was + step * max(1, round(abs(was * (factor - 1.0)))))
            return ast.BinOp(one, ast.Mult(), ast.Constant(factor))  # type: ignore[arg-type]

    Multiply().visit(node)


class _Finder(PathFinder):
    """Finder of the module with the changed constant."""

    scaled: tuple[str, str, float] = ("", "", 1.0)

    @classmethod
    def find_spec(cls, fullname: str, path: Any = None, target: Any = None) -> ModuleSpec | None:
        module, name, factor = cls.scaled
        if fullname != module:
            return None
        spec = super().find_spec(fullname, path, target)
        if spec is not None and spec.origin is not None:
            spec.loader = Scaled(module, spec.origin, name, factor)
        return spec


def figures(effort: float) -> dict[str, float]:
    """Return the figures of the force loop by name; `math.inf` where nothing is noticed."""
    from benchmarks.performance import force_ramps, touch  # after the finder is set

    def ramps(short: str, setup: force_ramps.Setup, step: int) -> None:
        cases = force_ramps.FAST[:: max(step, round(0.1 / effort))]
        found = []
        for case in cases:
            quality = force_ramps.grasp(setup, case, force_ramps.TRUTHS[1])
            found.append((quality, case.final_n))
        marks = [force_ramps.met(quality, final_n) for quality, final_n in found]
        for index, aim in enumerate(("overshoot", "settling", "hold")):
            made[f"{short}: {aim} met of {len(cases)}"] = sum(mark[index] for mark in marks)
        made[f"{short}: mean error in N"] = sum(q.holding_n for q, _ in found) / len(found)

    made: dict[str, float] = {}
    for short, step in (("messages", 3), ("messages, further truths", 3), ("frames", 4)):
        ramps(short, force_ramps.SETUPS[f"force loop, {short}"], step)
    measured = force_ramps.Setup(gearing="mx64", measured=True, rate_hz=force_ramps.GEARED_HZ)
    ramps("measured MX-64", measured, 6)
    errors, _ = force_ramps.measured_errors("mx64", "cork, 5 N/mm")
    made["measured MX-64: error of servos"] = max(abs(error) for one in errors for error in one)
    seeds = range(6000, 6000 + repeats(3, effort))
    for rate, rate_hz in (("200 Hz", 200.0), ("frames", None)):
        over_n = [touch.impact(rate_hz, seed, speed_m_s=0.015) for seed in seeds]
        made[f"{rate}: impact in N"] = max(over_n)
        for name, event in touch.TIMES.items():
            late_s = [event(rate_hz, seed) for seed in seeds]
            made[f"{rate}: {name}, in s"] = max(s for s in late_s if not math.isnan(s))
        reports = [touch.quiet(rate_hz, seed) for seed in seeds]
        reports += [touch.random_ramp(rate_hz, seed) for seed in range(6100, 6100 + 3 * len(seeds))]
        made[f"{rate}: wrong reports of {len(reports)}"] = sum(map(bool, reports))
    return made


def _run(constant: Constant | None, factor: float, effort: float) -> dict[str, float] | str:
    """Return the figures of a separate process, or the last line of its error."""
    scaled = ["", "", "1.0"] if constant is None else [constant.module, constant.name, str(factor)]
    own = [sys.executable, "-m", "benchmarks.performance.sensitivity", "--effort", str(effort)]
    done = subprocess.run(
        [*own, "--one", *scaled],
        capture_output=True,
        text=True,
        cwd=ROOT,
        timeout=_TIMEOUT_S,
        check=False,
    )
    if done.returncode:
        return (done.stderr.strip().splitlines() or ["no message"])[-1]
    return json.loads(done.stdout)


def moved(base: Mapping[str, float], found: Mapping[str, float] | str) -> list[str]:
    """Return the changed figures, each with its value before and now."""
    if isinstance(found, str):
        return [f"ends with {found:.120}"]
    texts = []
    for name, was in base.items():
        now = found[name]
        change = abs(now - was) if now != was else 0.0
        least = max(_MOVED_N if name.endswith("in N") else 0.02, _MOVED_SHARE * was)
        least = _MOVED_COUNT if " of " in name else least
        if change >= least:
            texts.append(f"{name} {was:.3g} to {now:.3g}")
    return texts


# -- all of them -------------------------------------------------------------------------------


def table(
    rows: Sequence[Constant], effects: Mapping[tuple[str, float], Sequence[str]]
) -> list[str]:
    """Return the lines of the page: one table for each sub-package."""
    lines = []
    packages: dict[str, list[Constant]] = {}
    for one in rows:
        packages.setdefault(one.key.split(".")[0], []).append(one)
    for package, members in packages.items():
        lines += [f"## {package}", "", "| constant | value | meaning | origin | x 2/3 | x 4/3 |"]
        lines += ["|---|---|---|---|---|---|"]
        for one in members:
            cells = [f"`{one.key.partition('.')[2] or one.name}`", f"`{one.value}`", one.text]
            ends = [
                ", ".join(effects[one.key, f]) or "-" for f in FACTORS if (one.key, f) in effects
            ]
            lines.append(f"| {' | '.join([*cells, one.origin, *(ends or ['', ''])])} |")
        lines.append("")
    return lines


def main(
    effort: float = 1.0, *, workers: int | None = None, only: str = "", page: bool = False
) -> None:
    """Measure all constants that are not computed, and print the changed figures."""
    rows = [one for one in constants() if only in one.key and one.origin in TRIED]
    rows = rows[:: round(1.0 / effort)] if effort < 1.0 else rows
    line("compared", f"{len(rows)} constants x 2 values")
    base = _run(None, 1.0, effort)
    if isinstance(base, str):
        raise SystemExit(base)
    for name, value in base.items():
        line(name, f"{value:.3g}")
    runs = [(one, factor) for one in rows for factor in FACTORS]
    effects: dict[tuple[str, float], Sequence[str]] = {}
    with ThreadPoolExecutor(workers or os.cpu_count()) as pool:
        found = pool.map(lambda one: _run(one[0], one[1], effort), runs)
        for (one, factor), its in zip(runs, found, strict=True):
            effects[one.key, factor] = moved(base, its)
            line(f"{one.key} x {factor:.2f}", ", ".join(effects[one.key, factor]) or "-")
    still = [one for one in rows if not any(effects[one.key, factor] for factor in FACTORS)]
    line("no figure moves", f"{len(still)} of {len(rows)} constants")
    if page:
        write_page(effects_on_page() | effects)


def effects_on_page() -> dict[tuple[str, float], Sequence[str]]:
    """Return the effects on the page, by constant."""
    found: dict[tuple[str, float], Sequence[str]] = {}
    package = ""
    for row in PAGE.read_text(encoding="utf-8").splitlines():
        if row.startswith("## "):
            package = row.removeprefix("## ")
        cells = row.strip("| ").split(" | ")
        if row.startswith("| `") and len(cells) == 6:
            key = f"{package}.{cells[0].strip('`')}"
            for factor, text in zip(FACTORS, cells[4:], strict=True):
                found[key, factor] = [] if text == "-" else [text]
    return found


def write_page(effects: Mapping[tuple[str, float], Sequence[str]]) -> None:
    """Write all constants, with the changed figures, into the page of the docs."""
    origins = [f"- **{name}**: {text}." for name, text in ORIGINS.items()]
    PAGE.write_text(
        "\n".join([_HEAD, *origins, "", *table(constants(), effects)]), encoding="utf-8"
    )
    line("  written", str(PAGE))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Which figures the constants of the force move.")
    parser.add_argument("--page", action="store_true", help=f"write {PAGE.name}")
    parser.add_argument("--texts", action="store_true", help=f"renew the texts of {PAGE.name}")
    parser.add_argument("--only", default="", help="part of the names of the constants wanted")
    parser.add_argument("--effort", type=float, default=1.0, help="share of the runs")
    parser.add_argument("--workers", type=int, help="processes at once")
    parser.add_argument("--one", nargs=3, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.one:
        _Finder.scaled = given.one[0], given.one[1], float(given.one[2])
        sys.meta_path.insert(0, _Finder())
        print(json.dumps(figures(given.effort)))
    elif given.texts:
        write_page(effects_on_page())
    else:
        main(given.effort, workers=given.workers, only=given.only, page=given.page)
