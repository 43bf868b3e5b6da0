"""Run every benchmark, or those named: python -m benchmarks [NAME ...].

`comparators` needs a data set of labelled grasps: python -m benchmarks comparators FILE.
"""

import importlib
import sys

BENCHMARKS = {
    "performance": ("archive", "force_cap", "force_ramps", "identify", "soak", "touch"),
    "recognition": ("comparators", "many_objects", "other_cell", "sensors"),
    "paper": ("method", "reproduction"),
}
"""Chapter -> the benchmarks in it: modules whose ``main(effort=1.0)`` prints their figures."""
ALONE = ("soak",)
"""Benchmarks that take hours: they run when they are named."""


def modules() -> dict[str, str]:
    """Return the module of each benchmark by its name."""
    return {
        name: f"benchmarks.{chapter}.{name}"
        for chapter, names in BENCHMARKS.items()
        for name in names
    }


def main() -> None:
    known, arguments = modules(), sys.argv[1:]
    if arguments[:1] == ["comparators"]:
        importlib.import_module(known["comparators"]).main(file=next(iter(arguments[1:]), None))
        return
    for name in arguments or [one for one in known if one not in ALONE]:
        if name not in known:
            sys.exit(f"no benchmark is named {name!r}; there are {', '.join(known)}")
        print(f"== {name}", flush=True)
        importlib.import_module(known[name]).main()
        print(flush=True)


if __name__ == "__main__":
    main()
