"""Does a test fail if the code is wrong? Mutants drawn at random, and the tests that find them.

    python -m tests.mutants draw mutants.json --n 60 --seed 1      needs the extra `mutants`
    python -m tests.mutants run mutants.json times.txt --limit 300

`draw` takes the changes from cosmic-ray (a comparison, a number, an operator, a condition). `run`
puts each mutant into a copy of the checkout and runs tests until one fails: those of the package's
own folder first, then all others, the quickest first. Names and times of the tests come from
`--processor-times`. A mutant that survives `--limit` s of tests is named so.
"""

import argparse
import ast
import json
import random
import shutil
import subprocess
import sys
import tempfile
import time
from itertools import pairwise
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
FOLDERS = ("gripper", "tactile", "cell/control", "recognition")
OPERATORS = (
    *(f"ReplaceBinaryOperator_{pair}" for pair in ("Add_Sub", "Sub_Add", "Mul_Div", "Div_Mul")),
    *(f"ReplaceComparisonOperator_{pair}" for pair in ("Lt_LtE", "Lt_GtE", "Gt_GtE", "Gt_LtE")),
    *(f"ReplaceComparisonOperator_{pair}" for pair in ("LtE_Lt", "GtE_Gt", "Eq_NotEq", "Is_IsNot")),
    *(f"ReplaceUnaryOperator_{pair}" for pair in ("USub_UAdd", "Delete_Not")),
    *("AddNot", "ReplaceTrueWithFalse", "ReplaceFalseWithTrue", "ReplaceAndWithOr"),
    *("ReplaceOrWithAnd", "NumberReplacer", "ZeroIterationForLoop"),
)
"""Operators of cosmic-ray; those that only make a TypeError are left out."""
_NOT_FOUND = "ERROR: not found"
"""Text of pytest for a test that it does not find. With the same exit status ends a mutant that
breaks an import of all tests."""
PYTEST = ("-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", "--timeout=300", "-n", "0")


def draw(n: int, seed: int) -> list[dict[str, Any]]:
    """Return mutants, drawn without a preference for a place: file, line, operator, new code."""
    from cosmic_ray.mutating import MutationVisitor
    from cosmic_ray.plugins import get_operator
    from parso import parse

    places = []
    for path in sorted(file for folder in FOLDERS for file in (ROOT / folder).rglob("*.py")):
        tree = parse(path.read_text(encoding="utf-8"))
        for name in OPERATORS:
            visitor = MutationVisitor(-1, get_operator(f"core/{name}")())
            visitor.walk(tree)
            places += [(path, name, occurrence) for occurrence in range(visitor._count)]
    mutants: list[dict[str, Any]] = []
    for path, name, occurrence in random.Random(seed).sample(places, len(places)):
        code = path.read_text(encoding="utf-8")
        mutated = MutationVisitor.mutate_code(code, get_operator(f"core/{name}")(), occurrence)
        if mutated is None or not _changes(code, mutated):
            continue
        pairs = zip(code.splitlines(), mutated.splitlines(), strict=False)
        line, old, new = next((i, *pair) for i, pair in enumerate(pairs, 1) if pair[0] != pair[1])
        where = {"file": str(path.relative_to(ROOT)), "line": line, "operator": name}
        mutants.append(where | {"old": old.strip(), "new": new.strip(), "code": mutated})
        if len(mutants) == n:
            break
    return mutants


def _changes(code: str, mutated: str) -> bool:
    """Return whether a mutant means something else; not every one of cosmic-ray is valid code."""
    try:
        return ast.dump(ast.parse(mutated)) != ast.dump(ast.parse(code))
    except SyntaxError:
        return False


def tests_of(mutant: dict[str, Any], times_s: dict[str, float]) -> list[str]:
    """Return the tests in their order for a mutant."""
    own = tuple(f"tests/{folder}/" for folder in FOLDERS if mutant["file"].startswith(folder))
    return sorted(times_s, key=lambda name: (not name.startswith(own), times_s[name]))


def verdict(mutant: dict[str, Any], tests: list[str], limit_s: float, copy: Path) -> str:
    """Run tests on a mutant in a copy of the checkout; return what became of it."""
    target = copy / mutant["file"]
    whole = target.read_text(encoding="utf-8")
    target.write_text(mutant["code"], encoding="utf-8")
    end_s = time.monotonic() + limit_s
    try:
        # The first tests in small portions: most mutants end there.
        for first, last in pairwise((0, 20, 100, 400, len(tests))):
            if not (some := tests[first:last]):
                continue
            try:
                ran = subprocess.run(
                    [sys.executable, *PYTEST, *some],
                    cwd=copy,
                    capture_output=True,
                    text=True,
                    timeout=max(1.0, end_s - time.monotonic()),
                    check=False,
                )
            except subprocess.TimeoutExpired:
                return f"survived {limit_s:.0f} s"
            if _NOT_FOUND in ran.stderr + ran.stdout:
                raise SystemExit(f"the tests cannot run: {(ran.stderr + ran.stdout)[-500:]}")
            if ran.returncode != 0:
                # A module that cannot be imported ends pytest with text on the other stream.
                lines = (ran.stderr + ran.stdout).splitlines() or [f"exit status {ran.returncode}"]
                failed = [one for one in lines if one.startswith("FAILED")]
                return f"killed: {(failed or lines)[-1][:150]}"
    finally:
        target.write_text(whole, encoding="utf-8")
    return "survived"


def main() -> None:
    """Draw mutants, or run them; print a line for each."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("do", choices=("draw", "run"))
    parser.add_argument("file", type=Path)
    parser.add_argument("times", type=Path, nargs="?", help="list of --processor-times")
    parser.add_argument("--n", type=int, default=60)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--limit", type=float, default=300.0, help="s for the tests of a mutant")
    given = parser.parse_args()
    if given.do == "draw":
        given.file.write_text(json.dumps(draw(given.n, given.seed), indent=1), encoding="utf-8")
        return
    rows = given.times.read_text(encoding="utf-8").splitlines()
    times_s = {name: float(took_s) for took_s, _, name in (row.partition(" ") for row in rows)}
    mutants = json.loads(given.file.read_text(encoding="utf-8"))
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder, "checkout")
        ignored = shutil.ignore_patterns(".venv", ".git", "out", ".*_cache")
        shutil.copytree(ROOT, copy, ignore=ignored)
        for mutant in mutants:
            mutant["verdict"] = verdict(mutant, tests_of(mutant, times_s), given.limit, copy)
            print(f"{mutant['file']}:{mutant['line']} {mutant['operator']}: {mutant['verdict']}")
            print(f"    {mutant['old']}  ->  {mutant['new']}", flush=True)
            given.file.write_text(json.dumps(mutants, indent=1), encoding="utf-8")
    killed = sum(mutant["verdict"].startswith("killed") for mutant in mutants)
    print(f"{killed} of {len(mutants)} killed")


if __name__ == "__main__":
    main()
