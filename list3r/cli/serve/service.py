"""serve: a catalogue over HTTP."""

from __future__ import annotations

import os
import secrets
from typing import Annotated

import typer

from list3r.cli.catalog.commands import CatalogOption
from list3r.cli.terminal import note, say
from list3r.memory.core.errors import OptionError

SECRET_VARIABLE = "LIST3R_SERVE_SECRET"
_FIRST_TOKEN_HOURS = 24.0


def serve(
    catalog: CatalogOption = "catalog.sqlite",
    host: Annotated[str, typer.Option("--host", help="Address to listen on.")] = "127.0.0.1",
    port: Annotated[int, typer.Option("--port", help="Port to listen on; 0: any free one.")] = 8750,
    workers: Annotated[int, typer.Option("--workers", metavar="N", help="Worker processes.")] = 1,
    timeout: Annotated[
        float, typer.Option("--timeout", metavar="SECONDS", help="Time allowed for one request.")
    ] = 10.0,
    hours: Annotated[
        float | None,
        typer.Option("--token-for", metavar="HOURS", help="Print a token that is valid for this long, and exit."),
    ] = None,
) -> None:
    """Serve a catalogue over HTTP. Clients send a token that --token-for made with the secret in LIST3R_SERVE_SECRET.
    Without a secret the service makes one and prints a token for a day.

    Example: list3r serve --catalog postgresql://db.example/list3r --workers 4
    """
    from list3r.server.http.tokens import make_token

    secret = os.environ.get(SECRET_VARIABLE)
    if hours is not None:
        if secret is None:
            raise OptionError(f"--token-for signs with the secret of the service; set {SECRET_VARIABLE}")
        say(make_token(secret, hours))
        return
    known, secret = secret is not None, secret or secrets.token_urlsafe(32)
    token = make_token(secret, _FIRST_TOKEN_HOURS)
    from list3r.server.http.limits import ServiceLimits
    from list3r.server.http.running import ServiceAddress
    from list3r.server.http.running import serve as run

    def started(address: str) -> None:
        note(address)
        note("Authorization: Bearer " + (f"TOKEN of --token-for and {SECRET_VARIABLE}" if known else token))

    run(catalog, secret, ServiceAddress(host, port, workers), ServiceLimits(request_s=timeout), started)
