"""Packages with plugins, as pip would install them."""

import tomllib
from collections.abc import Mapping
from pathlib import Path


def install(
    target: Path, name: str, entries: Mapping[str, Mapping[str, str]], version: str = "1.0.0"
) -> None:
    """Write the metadata of a distribution with these entry points by group."""
    info = target / f"{name.replace('-', '_')}-{version}.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
    lines = [
        line
        for group, points in entries.items()
        for line in (f"[{group}]", *(f"{key} = {value}" for key, value in points.items()))
    ]
    (info / "entry_points.txt").write_text("\n".join(lines) + "\n")


def install_project(target: Path, folder: Path) -> None:
    """Install a project by its pyproject.toml; its modules stay where they are."""
    project = tomllib.loads((folder / "pyproject.toml").read_text())["project"]
    install(target, project["name"], project["entry-points"], project["version"])
    (target / "project.pth").write_text(f"{folder}\n")
