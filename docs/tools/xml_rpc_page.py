"""The table of the XML-RPC methods, made from the methods themselves."""

import inspect

from cell.interfaces.xml_rpc import METHODS

_TYPES = {"dict[str, float]": "pose", "float": "double", "str": "string"}
"""Names of the types in URScript, where they differ."""


def xml_rpc_page() -> str:
    """Return one row for each method."""
    rows = ["| method | returns | what it does |", "| --- | --- | --- |"]
    for name, method in METHODS.items():
        signature = inspect.signature(method)
        named = ", ".join(str(one) for one in signature.parameters.values() if one.name != "self")
        for python, script in _TYPES.items():
            named = named.replace(f": {python}", f": {script}")
        returned = inspect.formatannotation(signature.return_annotation)
        text = " ".join((method.__doc__ or "").split())
        rows.append(f"| `{name}({named})` | {_TYPES.get(returned, returned)} | {text} |")
    return "\n".join(rows)
