"""The support bundle: what is in it, and that no secret is."""

import json
import os
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import pytest
from typer.testing import CliRunner

from cell.config.file import changed_config, config_text, parse_config
from cell.data.recording_messages import RecordedMessages
from cell.interfaces.access import view_token
from cell.interfaces.cli.app import app
from cell.interfaces.cli.support_bundle import REMOVED, without_secrets
from gripper.errors import GripperError
from tests.cell.conftest import MakeBench
from tests.cell.interfaces.hosts import Client
from tests.cell.served import Served

pytestmark = pytest.mark.slow

TOKEN, SECRET, PRINTED = "a-token-of-the-cell-1", "a-secret-of-the-cell-2", "printed-at-a-start-3"
SECRETS = (TOKEN, SECRET, PRINTED, view_token(TOKEN), view_token(SECRET))
JOURNAL = f"""#!/bin/sh
echo "page: http://cell:8080/#token={PRINTED}"
echo '{{"token": "{PRINTED}", "xmlrpc_port": 5021}}'
echo "somebody typed {TOKEN}"
"""


@pytest.fixture
def cell(
    serve: Any, make_bench: MakeBench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Served:
    """A service with secrets, a recording with a fault, a journal with tokens, and its config."""
    (tmp_path / "token").write_text(TOKEN)
    (tmp_path / "secret").write_text(SECRET)
    (tmp_path / "journalctl").write_text(JOURNAL)
    (tmp_path / "journalctl").chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    (tmp_path / "out/run-1").mkdir(parents=True)
    bench = make_bench(folder=tmp_path / "out/run-1").ready()
    bench.simulated.inject("servo1.off")
    with pytest.raises(GripperError):
        bench.grasp()
    bench.cell.close()
    served: Served = serve(
        "http",
        serve__token_file=str(tmp_path / "token"),
        serve__secret_file=str(tmp_path / "secret"),
        recording__directory=str(tmp_path / "out"),
    )
    port = served.interfaces["http_port"]
    config = changed_config(served.service.config, {"serve.http_port": port})
    (tmp_path / "cell.yaml").write_text(f"# the password is {TOKEN}\n{config_text(config)}")
    return served


def packed(folder: Path, *options: object) -> dict[str, bytes]:
    """Return the members of a new bundle."""
    file = folder / "bundle.zip"
    command = ["support", str(file), "-c", str(folder / "cell.yaml"), *map(str, options)]
    result = CliRunner().invoke(app, command)
    assert result.exit_code == 0, result.output
    with ZipFile(file) as archive:
        found = {name: archive.read(name) for name in archive.namelist()}
    assert all(f"  {name}: " in result.output for name in found)
    return found


def test_no_secret_of_the_cell_is_in_its_bundle(cell: Served, tmp_path: Path) -> None:
    Client(cell.interfaces).post("/api/lease", name=f"host with {SECRET}")
    found = packed(tmp_path)
    recording = tmp_path / "recording.mcap"
    recording.write_bytes(found["recording.mcap"])
    unpacked = b"".join(data for _, _, data in RecordedMessages(recording))
    for name, content in (*found.items(), ("recording", unpacked)):
        for secret in SECRETS:
            assert secret.encode() not in content, name
    config = parse_config(found["config.yaml"].decode(), source="bundle")
    assert (config.serve.token_file, config.serve.secret_file) == (REMOVED, REMOVED)
    assert config.recording.directory == str(tmp_path / "out")
    assert b"xmlrpc_port" in found["journal.txt"]
    assert b"host with removed" in found["state.txt"]


def test_the_bundle_has_what_a_helper_asks_for(cell: Served, tmp_path: Path) -> None:
    found = packed(tmp_path)
    assert json.loads(found["health.txt"].partition(b"\n")[2])["working"] is True
    assert json.loads(found["state.txt"].partition(b"\n")[2])["status"]["state"] == "IDLE"
    assert "tactile-cell" in json.loads(found["versions.json"])["packages"]
    ((recording, faults),) = json.loads(found["faults.json"]).items()
    assert recording.endswith("recording.mcap")
    assert {100 <= fault["fault_number"] < 200 for fault in faults} == {True}
    smaller = packed(tmp_path, "--limit-mb", "0.001")
    assert "recording.mcap" not in smaller
    assert b"bytes exceed the limit of 1000" in smaller["recording.txt"]


@pytest.mark.usefixtures("cell")
def test_without_a_service_the_bundle_says_so(tmp_path: Path) -> None:
    config = parse_config((tmp_path / "cell.yaml").read_text(), source="cell")
    silent = changed_config(config, {"serve.http_port": 1, "serve.token_file": ""})
    (tmp_path / "cell.yaml").write_text(config_text(silent))
    (tmp_path / "out/run-1/recording.mcap").write_bytes(b"no recording")
    found = packed(tmp_path)
    assert found["health.txt"].startswith(b"the service did not answer: ")
    assert all(json.loads(found["faults.json"]).values())  # why it cannot be read
    nothing = changed_config(silent, {"serve.http_port": None})
    (tmp_path / "cell.yaml").write_text(config_text(nothing))
    assert b"serve.http_port is not set" in packed(tmp_path)["health.txt"]


def test_what_is_written_as_a_token_is_removed() -> None:
    text = b'page: http://h:1/#token=AbC-1_2 "view_token": "xyz" Authorization: Bearer q.r'
    found = without_secrets(text, ())
    assert b"AbC" not in found
    assert b"xyz" not in found
    assert b"q.r" not in found
