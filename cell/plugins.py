"""Plugins: sensors, servo models and recognizers, found by entry points of installed packages.

Built-in plugins are listed in ``pyproject.toml``, as in any other package. Nothing is imported
before its use.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from pkgutil import resolve_name
from typing import Any

from cell.errors import ConfigError

OWN_PACKAGE = "tactile-cell"
"""Distribution of the built-in plugins."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Plugin:
    """One entry point."""

    group: str
    """Group without its prefix ``tactile_cell.``, for example sensors."""
    name: str
    """Name in a config."""
    package: str
    """Distribution with its version, for example ``tactile-cell 0.2.0``."""
    problem: str = ""
    """Reason that it cannot be loaded; empty where it can."""


@cache
def _entries(group: str) -> Mapping[str, tuple[EntryPoint, ...]]:
    """Return the entry points of a group by name; several packages may use one name."""
    entries = sorted(entry_points(group=f"tactile_cell.{group}"), key=lambda entry: entry.name)
    return {
        name: tuple({e.value: e for e in entries if e.name == name}.values())
        for name in dict.fromkeys(entry.name for entry in entries)
    }


def _package(entry: EntryPoint) -> str:
    return f"{entry.dist.name} {entry.dist.version}" if entry.dist else "unknown package"


class Plugins:
    """The plugins of one group by name; access loads a plugin.

    Parameters
    ----------
    group
        Group without its prefix.
    what
        Noun for a plugin of the group, for messages.
    kind
        Path of the class; each plugin is an instance or a subclass of it.
    """

    def __init__(self, group: str, what: str, kind: str = "collections.abc:Callable") -> None:
        self.group, self.what, self._kind = group, what, kind

    def __iter__(self) -> Iterator[str]:
        return iter(_entries(self.group))

    def __contains__(self, name: object) -> bool:
        return name in _entries(self.group)

    def __getitem__(self, name: str) -> Any:
        """Return a plugin. Raises ConfigError if it is unknown, ambiguous or cannot be loaded."""
        entry = self.entry(name)
        try:
            plugin, kind = entry.load(), resolve_name(self._kind)
            if not isinstance(plugin, kind) and not (
                isinstance(plugin, type) and issubclass(plugin, kind)
            ):
                raise TypeError(f"{entry.value} is not a {kind.__name__}")
        except (Exception, SystemExit) as error:
            raise ConfigError(
                f"{self.what} {name!r} of {_package(entry)} does not load: "
                f"{type(error).__name__}: {error}. Install what it needs, or another version"
            ) from error
        return plugin

    def entry(self, name: str) -> EntryPoint:
        """Return the entry point of a name without loading it. Raises ConfigError."""
        entries = _entries(self.group).get(name, ())
        if len(entries) > 1:
            packages = " and ".join(_package(entry) for entry in entries)
            raise ConfigError(f"{self.what} {name!r} is in {packages}: uninstall one of them")
        if not entries:
            names = ", ".join(self) or f"none: install {OWN_PACKAGE} again"
            near = get_close_matches(name.upper(), [key.upper() for key in self], n=1)
            meant = "".join(f"did you mean {key}? " for key in self if key.upper() in near)
            raise ConfigError(
                f"no {self.what} {name!r} is installed; {meant}installed are {names}. Install the "
                "package that brings it, then look at `tactile-cell doctor --plugins`"
            )
        return entries[0]

    def built_in(self, name: str) -> bool:
        """Return whether a plugin belongs to this project."""
        dist = self.entry(name).dist
        return dist is not None and dist.name == OWN_PACKAGE

    def package(self, name: str) -> str:
        """Return distribution and version of a plugin."""
        return _package(self.entry(name))

    def usable(self) -> dict[str, Any]:
        """Return the plugins that load, by name."""
        return {plugin.name: self[plugin.name] for plugin in self.examine() if not plugin.problem}

    def examine(self) -> Iterator[Plugin]:
        """Load each plugin and yield its description."""
        for name, entries in _entries(self.group).items():
            packages, problem = " and ".join(_package(entry) for entry in entries), ""
            try:
                self[name]
            except ConfigError as error:
                problem = str(error)
            yield Plugin(group=self.group, name=name, package=packages, problem=problem)


SENSORS = Plugins("sensors", "sensor", "cell.config.sensor:SensorConfig")
"""Sections of `tactile.sensor`: subclasses of `cell.config.sensor.SensorConfig`."""
SERVO_MODELS = Plugins("servo_models", "servo model", "gripper.dynamixel.models:ServoModel")
"""Values of `gripper.dynamixel.models.ServoModel`."""
RECOGNIZERS = Plugins("recognizers", "recognizer")
"""Factories of a `recognition.recognizer.Trainer`, called with ``use_aperture``."""
GROUPS = (SENSORS, SERVO_MODELS, RECOGNIZERS)
"""All groups."""
