"""Writes the tables that are made from the code into the pages: ``python -m docs.tools``.

In a page a table is between ``<!-- made: NAME -->`` and ``<!-- end: NAME -->``; logs are files of
their own. With ``--check`` nothing is written, and a page that differs from the code is an error.
"""

import re
import sys
from collections.abc import Callable
from pathlib import Path

from docs.tools.archive_page import archive_page
from docs.tools.campaign_page import campaign_page, reactions_page
from docs.tools.catalogue_page import catalogue_page
from docs.tools.command_page import overview_page
from docs.tools.modbus_page import commands_page, registers_page
from docs.tools.states_page import states_page, states_picture
from docs.tools.unit_page import start_log, vectors_page
from docs.tools.walk_page import walk_page
from docs.tools.xml_rpc_page import xml_rpc_page

MAKERS: dict[str, Callable[[], str]] = {
    "archive": archive_page,
    "campaign": campaign_page,
    "catalogue": catalogue_page,
    "commands": overview_page,
    "commissioning": walk_page,
    "modbus commands": commands_page,
    "modbus registers": registers_page,
    "reactions": reactions_page,
    "states": states_page,
    "states picture": states_picture,
    "unit vectors": vectors_page,
    "xml-rpc": xml_rpc_page,
}
"""What makes each table."""
LOGS = {"examples/control-unit-start.txt": start_log}
"""What makes each file."""
_TABLE = re.compile(r"(<!-- made: (.+?) -->\n).*?(<!-- end: \2 -->)", flags=re.S)


def filled(page: str) -> str:
    """Return a page, or a picture, with new tables."""
    return _TABLE.sub(lambda match: f"{match[1]}\n{MAKERS[match[2]]().strip()}\n\n{match[3]}", page)


def main() -> None:
    """Write all pages whose tables have changed; with ``--check``, name them and exit with 1."""
    docs = Path(__file__).parents[1]
    stale = []
    pages = sorted((*docs.glob("*/*.md"), *docs.glob("images/*.svg")))
    made = {path: filled(path.read_text(encoding="utf-8")) for path in pages}
    for path, new in (made | {docs / name: log() for name, log in LOGS.items()}).items():
        if not path.exists() or path.read_text(encoding="utf-8") != new:
            stale.append(str(path.relative_to(docs.parent)))
            if "--check" not in sys.argv:
                path.write_text(new, encoding="utf-8")
    if stale and "--check" in sys.argv:
        sys.exit(f"differ from the code: {', '.join(stale)}; write them with `make docs-pages`")


if __name__ == "__main__":
    main()
