"""Run every benchmark, or those named: python -m benchmarks [NAME ...].

`benchmarks.fuzz` measures nothing and has its own command (`make campaign`).
"""

import importlib
import pkgutil
import sys

import benchmarks


def main() -> None:
    names = sorted(
        module.name
        for module in pkgutil.iter_modules(benchmarks.__path__)
        if module.name[0] != "_" and module.name != "fuzz"
    )
    wanted = sys.argv[1:] or names
    for name in wanted:
        if name not in names:
            sys.exit(f"no benchmark is named {name!r}; there are {', '.join(names)}")
        print(f"== {name}", flush=True)
        importlib.import_module(f"benchmarks.{name}").main()
        print(flush=True)


if __name__ == "__main__":
    main()
