"""Coverage-guided fuzzing with atheris: python -m benchmarks._fuzz_coverage TARGET [libFuzzer's].

The inputs grow along the branches of the parsers that they reach. atheris is not among the
dependencies: pip install atheris (Linux). An input that breaks something is left in a file.
"""

import sys
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

_OURS = ["cell", "gripper", "simulator", "tactile"]


def _groups(data: bytes, size: int = 8) -> list[bytes]:
    return [data[at : at + size] for at in range(0, len(data), size)]


_ITEMS: dict[str, Callable[[bytes], Any]] = {
    "servo-status": lambda data: (data, [data], False),
    "servo-instruction": lambda data: ([data], False),
    "can-frame": lambda data: (0, [(part, len(part)) for part in _groups(data)]),
    "sdo-server": lambda data: [(0x605, part) for part in _groups(data)],
    "slcan-adapter": lambda data: [data],
    "dataset": lambda data: (False, data),
    "model": lambda data: (False, data),
    "recording": lambda data: (False, data),
    "config": lambda data: data.decode("utf-8", errors="replace"),
    "positioner": bytes,
    "shape": lambda data: data.decode("utf-8", errors="replace"),
    "mesh": bytes,
}
"""How bytes become an input of a target."""


def _seeds(trial: Any) -> list[bytes]:
    found: Sequence[Any] = [
        *getattr(trial, "files", ()),
        *getattr(trial, "lines", ()),
        *getattr(trial, "texts", ()),
        *getattr(trial, "parts", ()),
        *(kind[0] for kind in getattr(trial, "kinds", ())),
        *([trial.data] if hasattr(trial, "data") else []),
    ]
    return [entry if isinstance(entry, bytes) else entry.encode() for entry in found]


def main() -> None:
    try:
        import atheris
    except ModuleNotFoundError:
        sys.exit("atheris is not installed: pip install atheris")
    with atheris.instrument_imports(include=_OURS):
        from benchmarks.fuzz import TARGETS
    if len(sys.argv) < 2 or sys.argv[1] not in _ITEMS:
        sys.exit(f"name one of {', '.join(_ITEMS)}")
    name = sys.argv.pop(1)
    trial: Any = TARGETS[name].make()
    trial.sent, trial.last = set(), None
    item = _ITEMS[name]
    with tempfile.TemporaryDirectory() as folder:
        for number, data in enumerate(_seeds(trial)):
            (Path(folder) / str(number)).write_bytes(data)
        atheris.Setup([*sys.argv, folder], lambda data: trial.check(item(data)) and None)
        atheris.Fuzz()


if __name__ == "__main__":
    main()
