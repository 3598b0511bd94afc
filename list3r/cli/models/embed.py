"""embed: vectors of a text and image model, so that free words find instances."""

from __future__ import annotations

from typing import Annotated

import typer

from list3r.cli.answer import print_answer
from list3r.cli.bar import progress_bar
from list3r.cli.common import JsonOption, LicenceOption, MemoryArgument
from list3r.cli.terminal import say


def embed(
    memory: MemoryArgument,
    model: Annotated[str, typer.Option("--model", metavar="siglip2|clip", help="The text-image model.")] = "siglip2",
    weights: Annotated[
        str | None,
        typer.Option("--weights", metavar="DIR|REPOSITORY", help="Weights instead of the model's own."),
    ] = None,
    device: Annotated[str, typer.Option("--device", metavar="auto|cpu|cuda", help="Where it runs.")] = "auto",
    licence: LicenceOption = "research",
    json: JsonOption = False,
) -> None:
    """Embed every instance with a text-image model, so that any words can find it.

    Example: list3r embed house.l3r --model siglip2
    """
    from list3r.semantics.embedding import embed_memory

    with progress_bar("embedding", "chunks", quiet=json) as bar:
        report = embed_memory(memory, weights, device, bar.show, model=model, licence=licence)
    if json:
        print_answer([vars(report)])
        return
    say(f"{report.instances} instances have a vector in {report.space}")
    if report.without_picture:
        say(f"{report.without_picture} are in no stored picture")
