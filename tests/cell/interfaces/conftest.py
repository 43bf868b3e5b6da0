"""A served cell and a client over HTTP."""

from collections.abc import Callable
from typing import Any

import pytest

from tests.cell.interfaces.hosts import Client


@pytest.fixture
def connect(serve: Any) -> Callable[..., tuple[Any, Client]]:
    """Return the maker of a served cell and a client."""

    def make(**changes: Any) -> tuple[Any, Client]:
        served = serve("http", **changes)
        return served, Client(served.interfaces)

    return make


@pytest.fixture
def served(serve: Any) -> Any:
    return serve("http")


@pytest.fixture
def host(served: Any) -> Client:
    return Client(served.interfaces)
