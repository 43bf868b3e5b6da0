"""The operator's page: HTML, modules, style sheet and languages; a browser loads them unchanged.

The page uses the same paths below ``/api`` as any other client. The files here contain no data of
the cell and need no token.
"""

from importlib.resources import files
from pathlib import Path
from typing import Any

from fastapi import FastAPI
from starlette.responses import FileResponse, Response
from starlette.staticfiles import StaticFiles

FOLDER = Path(str(files(__name__))) / "static"
"""Folder of the served files."""
HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; "
    "img-src 'self'; connect-src 'self'; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-cache",
    "Permissions-Policy": "camera=(), microphone=(), geolocation=()",
}
"""Headers of each file. They forbid content of other origins, inline scripts and frames. The
browser checks for a newer version before it uses a stored file."""


class _Files(StaticFiles):
    def file_response(self, *args: Any, **kwargs: Any) -> Response:
        """Return a file, or status 304, with the headers of the page."""
        response = super().file_response(*args, **kwargs)
        response.headers.update(HEADERS)
        return response


def mount_page(app: FastAPI) -> None:
    """Serve the page at ``/`` and all files below ``/page``."""

    async def index() -> FileResponse:
        return FileResponse(FOLDER / "index.html", headers=HEADERS)

    app.add_api_route("/", index, methods=["GET"], include_in_schema=False)
    app.mount("/page", _Files(directory=FOLDER))
