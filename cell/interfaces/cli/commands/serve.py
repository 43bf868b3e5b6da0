"""`serve`: runs the cell and opens interfaces for PLCs, robot programs and other hosts."""

import json
import os
import socket
import threading
import time
from collections.abc import Mapping
from contextlib import ExitStack, closing, suppress
from math import inf
from pathlib import Path
from shutil import rmtree
from typing import Annotated, Any

import typer

from cell.config.file import changed_config
from cell.config.serve import ALL_CLOSED
from cell.control.states import CellState
from cell.errors import CellError, CellStopped, ConfigError
from cell.fault_catalogue import EXPECTED_ERRORS
from cell.installation import missing_note
from cell.interfaces.cli import options
from cell.interfaces.cli.session import (
    cell_config,
    job_folder,
    model_of_folder,
    release_command,
    with_faults,
)
from cell.interfaces.cli.signals import NOTHING_LET_GO, stopping
from cell.interfaces.cli.terminal import err, print_note, print_page, print_view
from cell.interfaces.opening import open_interfaces, page_address, view_note, warnings
from cell.service.service import Service, open_service

_FEEDS = 4
"""Messages to the watchdog within its time-out: three may be lost or late."""


class ServiceManager:
    """Sends states as sd_notify(3) does; without its environment variables it sends nothing."""

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        address = environment.get("NOTIFY_SOCKET", "")
        # "@" stands for the null byte of an abstract address.
        self._address = f"\0{address[1:]}" if address.startswith("@") else address
        ours = environment.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        limit_us = environment.get("WATCHDOG_USEC", "") if ours else ""
        self._feed_every_s = 1e-6 * int(limit_us or 0) / _FEEDS
        self._due_s = -inf if limit_us else inf
        self._status = ""

    def report(self, status: str, *, working: bool) -> None:
        """Send a new status, one line for people, and feed the watchdog while the cell works."""
        if status != self._status:
            self._status = status
            self.send(f"STATUS={status}")
        now_s = time.monotonic()
        if working and now_s >= self._due_s:
            self._due_s = now_s + self._feed_every_s
            self.send("WATCHDOG=1")

    def send(self, state: str) -> None:
        """Send a state, for example ``READY=1``."""
        if self._address:
            # If the service manager is gone or does not read, the cell has no fault.
            with (
                suppress(OSError),
                socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK) as link,
            ):
                link.sendto(state.encode(), self._address)


SIGNAL_LOOK_S = 0.25
"""Longest wait in s before signals are handled; Python handles them between two waits."""
_PAGE_PORT = 8080
"""Port for HTTP of the built-in cell; any free one if it is taken."""
_FIRST_GRASPS = 10
"""Grasps taught of each object at the first start of the built-in cell: half as many as `run`."""

SaveOption = Annotated[
    Path | None,
    typer.Option(
        "--save",
        help="Model file to write after each teaching, new or that of --model.",
        callback=options.in_a_folder,
    ),
]


def _port(flag: str, interface: str, key: str) -> typer.models.OptionInfo:
    """Return the option of an interface's port."""
    option: typer.models.OptionInfo = typer.Option(
        flag, help=f"Port of {interface}; 0: any [default: serve.{key}]."
    )
    return option


def serve(
    config: options.Config = None,
    model: options.FolderModel = None,
    save: SaveOption = None,
    listen: Annotated[
        str | None, typer.Option("--listen", help="Address to listen at [default: serve.listen].")
    ] = None,
    allow: Annotated[
        list[str] | None,
        typer.Option(
            "--allow",
            metavar="HOST",
            help="Host or network that may connect; repeat for several [default: this machine].",
        ),
    ] = None,
    modbus_port: Annotated[int | None, _port("--modbus", "Modbus TCP", "modbus_port")] = None,
    xmlrpc_port: Annotated[int | None, _port("--xml-rpc", "XML-RPC", "xmlrpc_port")] = None,
    http_port: Annotated[int | None, _port("--http", "HTTP", "http_port")] = None,
    token_file: Annotated[
        str | None,
        typer.Option("--token-file", help="File with HTTP's token [default: serve.token_file]."),
    ] = None,
    out_folder: Annotated[
        Path | None,
        typer.Option("--out", help="Folder for the recording; without it, nothing is recorded."),
    ] = None,
    speed: Annotated[
        float,
        typer.Option(
            "--speed",
            min=0.0,
            max=100.0,
            metavar="FACTOR",
            help="Speed of the simulated time, 1: real time; 0: as fast as possible, and stopped "
            "between two jobs.",
        ),
    ] = 1.0,
    faults: options.Faults = None,
) -> None:
    """Run the cell for people, PLCs, robot programs and other hosts, until Ctrl-C.

    Without a config file this is the simulated cell with five taught objects, and the page is
    available in a browser. Its address is printed on standard error, with the token on a terminal
    only. When clients can connect, one JSON line on standard output has all ports for a program. A
    part that is held at the end stays held.
    """
    own = cell_config(config)
    if config is None and http_port is None:
        http_port = free_page_port(listen or own.serve.listen)
    given: dict[str, Any] = {
        "serve.listen": listen,
        "serve.allow": allow,
        "serve.modbus_port": modbus_port,
        "serve.xmlrpc_port": xmlrpc_port,
        "serve.http_port": http_port,
        "serve.token_file": token_file,
    }
    checked = changed_config(
        with_faults(own, faults), {key: value for key, value in given.items() if value is not None}
    )
    if not checked.serve.ports:
        raise ConfigError(missing_note("serve", "page") or ALL_CLOSED)
    folder = None if out_folder is None else job_folder(out_folder, "serve")
    over = threading.Event()
    if save is None:
        model = model_of_folder(model)
    if model is not None and model == save and not model.exists():
        print_note(f"{model} does not exist: nothing is taught, and the first teaching writes it")
        model = None
    if save is None and config is not None:
        print_note("what is taught is in use until this program ends: --save FILE keeps it")
    untaught = config is None and model is None
    files: dict[str, Any] = {"save": save, "folder": folder}
    with ExitStack() as unused:
        if folder is not None:
            # A service manager starts a service many times: without a start no folder stays.
            unused.callback(rmtree, folder, ignore_errors=True)
        service = open_service(checked, model=model, note=print_note, start=False, **files)

        def stop() -> None:
            service.plugin.interrupt()  # first, so that each motion stops at once
            over.set()

        try:
            with (
                stopping(stop, left=NOTHING_LET_GO),
                closing(service),
                suppress(CellStopped),
                # Before anything moves, so that a used port or a bad token file ends it here.
                open_interfaces(service) as interfaces,
            ):
                unused.pop_all()
                _connect(service)
                _announce(service, interfaces)
                if untaught:
                    _teach_first(service, over)
                service.plugin.follow_real_time(speed)
                manager = ServiceManager()
                manager.send("READY=1")
                report_until(over, service, manager)
                manager.send("STOPPING=1")
        finally:
            # At the end: a release that was stopped half-way may have left a part.
            if config is not None and service.plugin.status().holding:
                print_note(f"a part may be in the grip; to release it: {release_command(config)}")


def _connect(service: Service) -> None:
    """Start the cell; a fault is latched, so that clients see it and can clear it."""
    try:
        service.plugin.connect()
    except EXPECTED_ERRORS:
        if service.plugin.status().state == CellState.STOPPED:
            raise
    if fault := service.plugin.status().fault:
        print_note(f"the cell is not ready: {fault}")
    if zero_note := service.plugin.health()["zero"]["text"]:
        print_note(zero_note)


def report_until(over: threading.Event, service: Service, manager: ServiceManager) -> None:
    """Report to the service manager until the end; a problem stops the running job."""
    noted = ""
    while not over.wait(SIGNAL_LOOK_S):
        problem = service.problem
        if problem and not noted:
            print_note(problem)
            service.stop(f"because {problem}")
        noted = problem
        manager.report(problem or _status_line(service), working=not problem)


def _status_line(service: Service) -> str:
    """Return state, grip and fault of the cell as one line."""
    status = service.plugin.status()
    held = ", a part may be held" if status.holding else ""
    return f"{status.state}{held}" + (f", fault {status.fault_number}" if status.fault else "")


def _announce(service: Service, interfaces: Mapping[str, Any]) -> None:
    """Print the addresses of the open interfaces of a service."""
    for note in warnings(service):
        print_note(note)
    config = service.config.serve
    # Other users may read the journal or the log of a container, for months.
    secret = ("token", "view_token")
    typer.echo(json.dumps({name: interfaces[name] for name in interfaces if name not in secret}))
    page, view = (page_address(interfaces, config, which) for which in secret)
    if page and not err.is_terminal:
        where = (
            f"its token is in {config.token_file}"
            if config.token_file
            else "its token is shown on a terminal only; --token-file FILE sets one"
        )
        print_page(f"{page.partition('#')[0]} ({where})")
    elif page and view:
        print_page(page)
        print_view(view, view_note(config))
    elif config.http_port is None:
        print_note("the page for a browser is off: open it with --http 8080 or serve.http_port")


def free_page_port(listen: str) -> int | None:
    """Return the port for the page, 0 for any; without its extra None, with a note."""
    if no_page := missing_note("serve", "page"):
        print_note(no_page)
        return None
    family = socket.AF_INET6 if ":" in listen else socket.AF_INET
    try:
        socket.create_server((listen, _PAGE_PORT), family=family).close()
    except OSError as error:
        print_note(f"port {_PAGE_PORT}: {error.strerror}; the page gets a free one, see below")
        return 0
    return _PAGE_PORT


def _teach_first(service: Service, over: threading.Event) -> None:
    """Teach the objects of the built-in cell, visible on the page."""
    labels = [entry.label for entry in service.config.simulator.objects]
    print_note(
        f"teaches {_FIRST_GRASPS} grasps each of {', '.join(labels)}, which takes about half a "
        "minute; --model FILE names a taught model"
    )
    try:
        lease = service.lease.acquire("first start")
        for seed, label in enumerate(labels):
            goal = {"task": "teach", "label": label, "grasps": _FIRST_GRASPS, "seed": seed}
            number = service.start(lease, goal)
            while not (job := service.plugin.job(number)).terminal:
                if over.wait(SIGNAL_LOOK_S):
                    return
                service.lease.alive(lease)
            if job.error:
                raise CellError(job.error)
        service.lease.give_up(lease)
    except CellError as error:
        print_note(f"not all objects were taught: {error}")
