"""Run every benchmark, or those named: python -m benchmarks [NAME ...].

`comparators` needs a data set of labelled grasps: python -m benchmarks comparators FILE.
`servo_logs` needs a folder of logs of real servos: python -m benchmarks servo_logs FOLDER.
"""

import importlib
import sys

_CHAPTERS = {
    "performance": ("force_cap", "force_ramps", "identify", "servo_logs", "soak"),
    "recognition": ("comparators", "other_cell", "sensors"),
    "paper": ("method", "reproduction"),
}
MODULES = {
    name: f"benchmarks.{chapter}.{name}" for chapter, names in _CHAPTERS.items() for name in names
}
"""Modules whose ``main(effort=1.0)`` prints figures, by the name of the benchmark."""
WITH_DATA = {"comparators": "file", "servo_logs": "folder"}
"""Benchmarks that need data, and what of it: the argument after the name."""
ALONE = ("soak",)
"""Benchmarks that take hours: they run when they are named."""


def main() -> None:
    arguments = sys.argv[1:]
    if arguments and arguments[0] in WITH_DATA:
        given = {WITH_DATA[arguments[0]]: next(iter(arguments[1:]), None)}
        importlib.import_module(MODULES[arguments[0]]).main(**given)
        return
    for name in arguments or [key for key in MODULES if key not in ALONE]:
        if name not in MODULES:
            sys.exit(f"no benchmark is named {name!r}; there are {', '.join(MODULES)}")
        print(f"== {name}", flush=True)
        importlib.import_module(MODULES[name]).main()
        print(flush=True)


if __name__ == "__main__":
    main()
