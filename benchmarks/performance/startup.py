"""Start of the program: time and modules of `--help`, a Tab completion, the plugin's import.

Each is a process of its own, as a shell or a host program starts it. The aim is 0.5 s for help and
completion; ``import numpy`` beside them shows how fast the machine is at loading.
"""

import os
import statistics
import subprocess
import sys
import time
from dataclasses import dataclass

from benchmarks._measure import in_turns, line, ratio, repeats

_COUNT = "import atexit, sys; atexit.register(lambda: print(len(sys.modules), file=sys.stderr));"
_PROGRAM = _COUNT + ("sys.argv[0] = 'tactile-cell'; from cell.interfaces.cli import main; main()")
_COMPLETION = {
    "_TACTILE_CELL_COMPLETE": "complete_bash",
    "COMP_WORDS": "tactile-cell run --",
    "COMP_CWORD": "2",
}
CASES: dict[str, tuple[tuple[str, ...], dict[str, str]]] = {
    "import numpy": ((_COUNT + "import numpy",), {}),
    "tactile-cell --help": ((_PROGRAM, "--help"), {}),
    "tactile-cell run --<Tab>": ((_PROGRAM,), _COMPLETION),
    "import of the plugin": ((_COUNT + "import cell.interfaces.plugin.plugin",), {}),
}
"""What is started: the arguments of ``python -c`` and what is added to the environment."""


@dataclass(frozen=True, slots=True)
class Start:
    """One start: time on the wall in s, and modules that were loaded at its end."""

    wall_s: float
    n_modules: int


def start(arguments: tuple[str, ...], environment: dict[str, str]) -> Start:
    """Start a program and wait for its end. Raises CalledProcessError if it fails."""
    begun_s = time.perf_counter()
    ended = subprocess.run(
        [sys.executable, "-c", *arguments],
        env=os.environ | environment,
        capture_output=True,
        text=True,
        check=True,
    )
    return Start(time.perf_counter() - begun_s, int(ended.stderr.split()[-1]))


def main(effort: float = 1.0) -> None:
    found = in_turns(
        {name: lambda case=case: start(*case) for name, case in CASES.items()},
        repeats(10, effort),
    )
    print("compared: starts of the program with `import numpy`, median of the ratios of the rounds")
    base = [one.wall_s for one in found["import numpy"]]
    for name, starts in found.items():
        wall_s = [one.wall_s for one in starts]
        line(
            name,
            f"{statistics.median(wall_s):5.2f} s, slowest {max(wall_s):.2f} s, "
            f"{starts[0].n_modules:5d} modules  ratio {ratio(wall_s, base):.2f}",
        )


if __name__ == "__main__":
    main()
