"""Python reference: the public names of a package, and every class in their signatures."""

import inspect
from collections.abc import Iterator
from importlib import import_module
from typing import Any, get_args, get_type_hints


def api_page(package: str) -> str:
    """Return the directives of a package's names, and of all classes that their signatures name.

    Functions come first: they are where to begin.
    """
    face = import_module(package)
    names = sorted(face.__all__, key=lambda name: name[0].isupper())
    members = {name: getattr(face, name) for name in names if not name.isupper()}
    waiting = [one for face_one in members.values() for one in _named(face_one)]
    places = {one: f"{package}.{name}" for name, one in members.items()}
    while waiting:
        one = waiting.pop(0)
        if one.__module__.partition(".")[0] == package and one not in places:
            places[one] = f"{one.__module__}.{one.__qualname__}"
            waiting += _named(one)
    return "".join(f"\n```{{eval-rst}}\n{_directive(places[one], one)}\n```\n" for one in places)


def _directive(place: str, one: Any) -> str:
    if inspect.isfunction(one):
        return f".. autofunction:: {place}"
    return f".. autoclass:: {place}\n   :members:\n   :show-inheritance:"


def _named(one: Any) -> list[Any]:
    """Return the classes in the signatures of a function, or of a class's public members."""
    hints: list[Any] = []
    for part in (one, *_members(one)):
        try:
            hints += get_type_hints(part).values()
        except (NameError, TypeError):
            continue
    return [member for hint in hints for member in _classes(hint)]


def _members(one: Any) -> Iterator[Any]:
    if not inspect.isclass(one):
        return
    for name, member in vars(one).items():
        if name.startswith("_") and name != "__init__":
            continue
        if isinstance(member, property):
            yield member.fget
        elif isinstance(member, classmethod | staticmethod):
            yield member.__func__
        elif inspect.isfunction(member):
            yield member


def _classes(hint: Any) -> Iterator[Any]:
    if inspect.isclass(hint) and not get_args(hint):
        yield hint
    for part in get_args(hint):
        for inner in part if isinstance(part, list) else [part]:
            yield from _classes(inner)
    origin = getattr(hint, "__origin__", None)
    if inspect.isclass(origin):
        yield origin
