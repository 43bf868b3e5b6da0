"""The README's test is that of a page; the example of hosts runs; what the README names exists."""

import json
import os
import re
import runpy
import subprocess
import sys
import urllib.request
from pathlib import Path

import pytest

from benchmarks.__main__ import modules

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def test_readme_shows_the_test_that_is_run() -> None:
    page = (ROOT / "docs/how-to/test-your-cell.md").read_text(encoding="utf-8")
    shown, typed = (re.findall(r"```python\n.*?```", text, re.DOTALL) for text in (README, page))
    assert shown == typed


@pytest.mark.slow
@pytest.mark.long
def test_the_example_teaches_and_identifies(capsys: pytest.CaptureFixture[str]) -> None:
    runpy.run_path(str(ROOT / "docs/examples/host_program.py"), run_name="__main__")
    printed = capsys.readouterr().out
    assert printed.count("robot:") >= 19
    name, shape, kept = printed.splitlines()[-3:]
    assert name.startswith("box, ")
    assert re.match(r"it feels like: flat, (9\.[7-9]|10\.[0-3]) mm", shape)
    assert kept == "  robot: to the bin of box, the part in the grip: True"


QUICK_START = README.partition("## Quick start")[2].partition("\n## ")[0]


def test_the_quick_start_installs_what_its_commands_need() -> None:
    (extras,) = re.findall(r"`pip install '\.\[(.*)\]'`", QUICK_START)
    assert extras == "report,serve"


@pytest.mark.long
@pytest.mark.timeout(900)
def test_the_quick_start_does_what_its_comments_say(tmp_path: Path) -> None:
    *commands, serve = re.findall(r"^    (.+)$", QUICK_START.partition("```")[0], re.MULTILINE)
    folder = str(Path(sys.executable).parent)
    env = os.environ | {"PATH": f"{folder}:{os.environ['PATH']}", "COLUMNS": "200"}

    def shell(command: str) -> str:
        done = subprocess.run(
            ["bash", "-c", command],
            check=False,
            cwd=tmp_path,
            env=env,
            text=True,
            capture_output=True,
        )
        assert done.returncode == 0, f"{command}\n{done.stdout}{done.stderr}"
        return done.stdout

    init, teach, draw, train, identify, sort = map(shell, commands)
    assert "wrote tactile-cell.yaml" in init
    for part in ("ball", "box", "cylinder"):
        assert f"6 of 6 grasps of {part} added" in teach
    assert "virtual grasps of pin added to parts.npz (18 before)" in draw
    assert "4 objects taught" in train
    assert "answer: ball" in identify
    assert "20 parts sorted" in sort
    assert "mistakes: none" in sort
    assert not re.search(r"teach (oval|dumbbell)", sort)

    printed, _, _ = serve.partition("#")
    command = ["bash", "-c", f"exec {printed} --modbus 0 --xml-rpc 0 --http 0"]
    with subprocess.Popen(
        command, cwd=tmp_path, env=env, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
    ) as running:
        try:
            assert running.stdout is not None
            ports = json.loads(running.stdout.readline())
            assert ports["modbus_port"]
            assert ports["xmlrpc_port"]
            url = f"http://127.0.0.1:{ports['http_port']}/"
            with urllib.request.urlopen(url, timeout=10) as page:
                assert b"<html" in page.read()
        finally:
            running.terminate()
    assert running.returncode == 0


def test_files_that_the_pages_at_the_root_name_exist() -> None:
    for page in ROOT.glob("*.md"):
        for target in re.findall(r"\]\(([^)#:]+)[^)]*\)", page.read_text(encoding="utf-8")):
            assert (ROOT / target).exists(), f"{page.name} names {target}"


def test_benchmarks_that_the_docs_name_exist() -> None:
    pages = [ROOT / "README.md", *ROOT.glob("docs/*/*.md")]
    named = [
        (page.name, name)
        for page in pages
        for names in re.findall(r"`python -m benchmarks ([a-z_ ]+)`", page.read_text("utf-8"))
        for name in names.split()
    ]
    assert len(named) > 8
    assert not [found for found in named if found[1] not in modules()]
