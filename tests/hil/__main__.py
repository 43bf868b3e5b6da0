"""Run the tests in real time, and say in the open which of them needed a second attempt.

    python -m tests.hil [PYTEST_OPTION ...]

A test that judges times can fail where another program takes the processors for a moment. So what
fails is run once more, and the last lines name it with the load of the machine. What needs a second
attempt on a quiet machine is a defect: of the test, or of the product.
"""

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest

PYTEST = ("-m", "pytest", "-m", "real_time and not long")
"""What is long (the whole commissioning in a terminal, further faults of the servo line) runs with
the option ``-m "real_time and long"``."""
ATTEMPTS = 2


def main(options: Sequence[str]) -> int:
    """Run the tests and return pytest's exit code of the last attempt."""
    names: list[str] = []
    said: list[str] = []
    code = 0
    with TemporaryDirectory() as cache:
        failed = Path(cache, "v", "cache", "lastfailed")
        command = [sys.executable, *PYTEST, "-o", f"cache_dir={cache}"]
        for attempt in range(1, ATTEMPTS + 1):
            load = os.getloadavg()[0]
            code = subprocess.run([*command, *options, *names], check=False).returncode
            if code != pytest.ExitCode.TESTS_FAILED:
                break
            names = list(json.loads(failed.read_text(encoding="utf-8")))
            said += [f"attempt {attempt}, load {load:.1f}: {name} failed" for name in names]
    quiet = os.getloadavg()[0] <= (os.cpu_count() or 1)
    print(
        f"{'quiet' if quiet else 'NOT a quiet'} machine; {len(said)} attempts failed",
        *said,
        sep="\n",
    )
    return code


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
