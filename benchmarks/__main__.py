"""Run every benchmark, or those named: python -m benchmarks [NAME ...].

`benchmarks.fuzz` measures nothing and `benchmarks.soak` takes an hour: they have commands of their
own (`make campaign`, `make soak`). `fault_campaign` measures nothing either, and runs where it is
named.
"""

import importlib
import pkgutil
import sys

import benchmarks

NAMED_ONLY = ("fault_campaign",)
OWN_COMMAND = ("fuzz", "soak", *NAMED_ONLY)


def main() -> None:
    names = sorted(
        module.name
        for module in pkgutil.iter_modules(benchmarks.__path__)
        if module.name[0] != "_" and module.name not in OWN_COMMAND
    )
    wanted = sys.argv[1:] or names
    for name in wanted:
        if name not in (*names, *NAMED_ONLY):
            known = ", ".join((*names, *NAMED_ONLY))
            sys.exit(f"no benchmark is named {name!r}; there are {known}")
        print(f"== {name}", flush=True)
        importlib.import_module(f"benchmarks.{name}").main()
        print(flush=True)


if __name__ == "__main__":
    main()
