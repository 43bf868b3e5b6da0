"""The operator's page: HTML, modules, style sheet and languages, which a browser loads as they are.

The page commands and shows through the same paths below ``/api`` as any other client; what is here
holds nothing of the cell and needs no token.
"""

from importlib.resources import files
from pathlib import Path
from typing import Any

from fastapi import FastAPI
from starlette.responses import FileResponse, Response
from starlette.staticfiles import StaticFiles

FOLDER = Path(str(files(__name__))) / "static"
"""The files that are served."""
HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; "
    "img-src 'self' blob:; connect-src 'self'; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-cache",
    "Permissions-Policy": "camera=(self), microphone=(), geolocation=()",
}
"""Headers of each file: nothing from elsewhere and nothing inline is loaded, the page stands in no
frame, and a browser asks whether a file has changed before it uses one that it has kept."""


class _Files(StaticFiles):
    def file_response(self, *args: Any, **kwargs: Any) -> Response:
        """Return a file, or that it has not changed, with the headers of the page."""
        found = super().file_response(*args, **kwargs)
        found.headers.update(HEADERS)
        return found


def mount_page(app: FastAPI, name: str = "index.html") -> None:
    """Serve the page of that name at ``/`` and all files below ``/page``."""

    async def index() -> FileResponse:
        return FileResponse(FOLDER / name, headers=HEADERS)

    app.add_api_route("/", index, methods=["GET"], include_in_schema=False)
    app.mount("/page", _Files(directory=FOLDER))
