"""`serve`: owns the cell and opens doors for PLCs, robot programs and other hosts."""

import json
import threading
from contextlib import closing
from pathlib import Path
from typing import Annotated, Any

import typer

from cell.interfaces.cli.options import ConfigOption, FaultOption, ModelOption

_LOOK_S = 0.5
"""Wait in s after which signals are looked for; Python carries them out between two waits."""

TrainingSetOption = Annotated[
    Path | None,
    typer.Option(
        "--training-set", help="Data set that trained the model [default: the one beside it]."
    ),
]
SaveOption = Annotated[
    Path | None, typer.Option("--save", help="Model file to write after each teaching.")
]


def serve(
    config: ConfigOption = None,
    model: ModelOption = None,
    training_set: TrainingSetOption = None,
    save: SaveOption = None,
    listen: Annotated[
        str | None,
        typer.Option("--listen", help="Address to listen at [default: serve.listen]."),
    ] = None,
    allow: Annotated[
        list[str] | None,
        typer.Option("--allow", help="Host or network that may connect; repeat for several."),
    ] = None,
    modbus_port: Annotated[
        int | None,
        typer.Option("--modbus", help="Port of Modbus TCP; 0: any [default: serve.modbus_port]."),
    ] = None,
    xmlrpc_port: Annotated[
        int | None,
        typer.Option("--xml-rpc", help="Port of XML-RPC; 0: any [default: serve.xmlrpc_port]."),
    ] = None,
    http_port: Annotated[
        int | None,
        typer.Option("--http", help="Port of HTTP; 0: any [default: serve.http_port]."),
    ] = None,
    out_folder: Annotated[
        Path | None,
        typer.Option("--out", help="Folder for the recording; without it none is made."),
    ] = None,
    opcua_port: Annotated[
        int | None,
        typer.Option("--opcua", help="Port of OPC UA; 0: any [default: serve.opcua_port]."),
    ] = None,
    opcua_folder: Annotated[
        str | None,
        typer.Option(
            "--opcua-folder",
            help="Certificates of OPC UA; without: read-only [default: serve.opcua_folder].",
        ),
    ] = None,
    faults: FaultOption = None,
) -> None:
    """Own the cell and serve PLCs, robot programs and other hosts, until SIGTERM.

    Prints one JSON line with its addresses when they can connect. What is held at the end stays
    held.
    """
    from cell.config.file import changed_config
    from cell.interfaces.cli.session import cell_config
    from cell.interfaces.cli.signals import END_WITHIN_S, stopping
    from cell.interfaces.cli.terminal import print_note
    from cell.interfaces.service.serving import open_doors, open_service, warnings
    from cell.jobs.common import job_folder

    given: dict[str, Any] = {
        "serve.listen": listen,
        "serve.allow": allow,
        "serve.modbus_port": modbus_port,
        "serve.xmlrpc_port": xmlrpc_port,
        "serve.http_port": http_port,
        "serve.opcua_port": opcua_port,
        "serve.opcua_folder": opcua_folder,
    }
    checked = changed_config(
        cell_config(config, faults=faults),
        {key: value for key, value in given.items() if value is not None},
    )
    folder = None if out_folder is None else job_folder(out_folder, "serve")
    over = threading.Event()
    with stopping(over.set, end_within_s=END_WITHIN_S):
        service = open_service(
            checked,
            model=model,
            training_set=training_set,
            save=save,
            folder=folder,
            note=print_note,
        )
        with closing(service), open_doors(service) as found:
            for note in warnings(service):
                print_note(note)
            typer.echo(json.dumps(found))
            while not over.wait(_LOOK_S):
                pass
