"""Does a test fail if the code is wrong? Mutants drawn at random, and the tests that find them.

    python -m tests.mutants draw 60 --seed 1 mutants.json       needs the extra `mutants`
    python -m tests.mutants run mutants.json --limit 300

`draw` takes the changes from cosmic-ray (a comparison, a number, an operator, a condition). `run`
needs the coverage of each test, from `make test PYTEST_ARGS="--cov --cov-context=test"`. It puts
each mutant into a copy of the checkout and runs the tests that execute the changed line, the
quickest first, until one fails. A mutant that survives `--limit` s of these tests is named so.
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
from collections.abc import Iterator
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
            operator = get_operator(f"core/{name}")()
            visitor = MutationVisitor(-1, operator)
            visitor.walk(tree)
            places += [(path, name, occurrence) for occurrence in range(visitor._count)]
    mutants: list[dict[str, Any]] = []
    for path, name, occurrence in random.Random(seed).sample(places, len(places)):
        code = path.read_text(encoding="utf-8")
        mutated = MutationVisitor.mutate_code(code, get_operator(f"core/{name}")(), occurrence)
        if mutated is None or ast.dump(ast.parse(mutated)) == ast.dump(ast.parse(code)):
            continue
        pairs = zip(code.splitlines(), mutated.splitlines(), strict=False)
        line, old, new = next((i, *pair) for i, pair in enumerate(pairs, 1) if pair[0] != pair[1])
        where = {"file": str(path.relative_to(ROOT)), "line": line, "operator": name}
        mutants.append(where | {"old": old.strip(), "new": new.strip(), "code": mutated})
        if len(mutants) == n:
            break
    return mutants


def tests_of(mutant: dict[str, Any], coverage_file: Path) -> list[str]:
    """Return the tests that execute the line of a mutant, or its statement where it has more."""
    from coverage import CoverageData

    data = CoverageData(str(coverage_file))
    data.read()
    contexts = data.contexts_by_lineno(str(ROOT / mutant["file"]))
    lines = _statement(ast.parse((ROOT / mutant["file"]).read_text()), mutant["line"])
    found = {name.partition("|")[0] for line in lines for name in contexts.get(line, ())}
    return sorted(found - {""})


def _statement(tree: ast.AST, line: int) -> range:
    """Return the lines of the smallest statement with a line."""
    return min(
        (
            range(node.lineno, (node.end_lineno or node.lineno) + 1)
            for node in ast.walk(tree)
            if isinstance(node, ast.stmt) and node.lineno <= line <= (node.end_lineno or line)
        ),
        key=len,
    )


def verdict(mutant: dict[str, Any], tests: list[str], limit_s: float, copy: Path) -> str:
    """Run tests on a mutant in a copy of the checkout; return what became of it."""
    target = copy / mutant["file"]
    whole = target.read_text(encoding="utf-8")
    target.write_text(mutant["code"], encoding="utf-8")
    end_s = time.monotonic() + limit_s
    try:
        for some in _portions(tests):
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
            if ran.returncode != 0:
                failed = [one for one in ran.stdout.splitlines() if one.startswith("FAILED")]
                return f"killed: {(failed or ran.stdout.splitlines())[-1][:150]}"
    finally:
        target.write_text(whole, encoding="utf-8")
    return "survived" if tests else "no test"


def _portions(tests: list[str]) -> Iterator[list[str]]:
    """Give the first tests in small portions: most mutants end there."""
    first = 0
    for size in (20, 80, 300):
        if tests[first : first + size]:
            yield tests[first : first + size]
        first += size
    if tests[first:]:
        yield tests[first:]


def main() -> None:
    """Draw mutants, or run them; print a line for each."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("do", choices=("draw", "run"))
    parser.add_argument("n", type=int, nargs="?", default=60)
    parser.add_argument("file", type=Path)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--limit", type=float, default=300.0, help="s for the tests of a mutant")
    parser.add_argument("--times", type=Path, help="list of --processor-times, for the order")
    parser.add_argument("--coverage", type=Path, default=ROOT / ".coverage")
    given = parser.parse_args()
    if given.do == "draw":
        given.file.write_text(json.dumps(draw(given.n, given.seed), indent=1), encoding="utf-8")
        return
    times_s: dict[str, float] = {}
    if given.times:
        rows = given.times.read_text(encoding="utf-8").splitlines()
        times_s = {name: float(took_s) for took_s, _, name in (row.partition(" ") for row in rows)}
    mutants = json.loads(given.file.read_text(encoding="utf-8"))
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder, "checkout")
        ignored = shutil.ignore_patterns(".venv", ".git", "out", ".*_cache")
        shutil.copytree(ROOT, copy, ignore=ignored)
        for mutant in mutants:
            tests = sorted(
                tests_of(mutant, given.coverage), key=lambda name: times_s.get(name, 1.0)
            )
            mutant["verdict"] = verdict(mutant, tests, given.limit, copy)
            print(f"{mutant['file']}:{mutant['line']} {mutant['operator']}: {mutant['verdict']}")
            print(f"    {mutant['old']}  ->  {mutant['new']}", flush=True)
            given.file.write_text(json.dumps(mutants, indent=1), encoding="utf-8")
    killed = sum(mutant["verdict"].startswith("killed") for mutant in mutants)
    print(f"{killed} of {len(mutants)} killed")


if __name__ == "__main__":
    main()
