"""The program `list3r`: its commands, and the one place where errors become one line and an exit status.

Status 0: done. 1: the program failed, was interrupted, or a check found damage. 2: the input is wrong, and how to fix
it is said.
"""

from __future__ import annotations

import functools
import importlib
import os
import signal
import sys
import warnings
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from types import FrameType, ModuleType
from typing import Any

import typer
import typer.core

from list3r.cli.answer import print_error, wants_json
from list3r.cli.common import expanded
from list3r.cli.terminal import OutputError, flush, mute, note, prepare_streams, say
from list3r.memory.core.address_space import BUILD_MB, check_address_space
from list3r.memory.core.errors import List3rError, MemoryFileWarning, naming_extras

MODULES: dict[str, tuple[str, ...]] = {
    "build.commands": ("inspect", "build", "demo"),
    "build.exchange": ("convert", "import"),
    "build.update": ("update",),
    "build.batch": ("batch",),
    "ask.memory": ("info", "list", "show"),
    "ask.query": ("find", "nearest", "relations", "similar", "within", "seen", "path"),
    "ask.changes": ("changes",),
    "ask.rooms": ("rooms",),
    "ask.picture": ("picture",),
    "edit.commands": ("edit",),
    "edit.export": ("export",),
    "edit.files": ("verify", "repair", "doctor"),
    "models.embed": ("embed",),
    "models.detect": ("detect",),
    "models.names": ("names",),
    "models.commands": ("models", "precompute"),
    "measure.commands": ("eval",),
    "serve.view": ("view",),
    "serve.mcp": ("mcp", "ask-config"),
    "serve.service": ("serve",),
    "catalog.commands": ("catalog",),
}
"""The commands of each module of this folder; it is imported when one of them is asked for, or the help."""
FUNCTIONS = {"list": "list_instances", "import": "import_map", "eval": "measures", "catalog": "catalogue"}
"""Functions and groups of commands that have another name than their command."""
FIRST: dict[str, tuple[str, ...]] = {
    "Build": ("build", "update"),
    "Look": ("info", "list", "show", "rooms", "view"),
    "Ask": ("find", "nearest", "relations", "similar", "changes"),
    "Change and use": ("names", "edit", "export"),
}
"""Sections of the first screen of the help, in order: what most people need, at most 15 commands."""
REST: dict[str, tuple[str, ...]] = {
    "Videos": ("demo", "inspect", "convert", "precompute", "batch"),
    "More questions": ("within", "seen", "path", "picture"),
    "Names and words": ("detect", "embed", "models"),
    "Agents and other programs": ("mcp", "ask-config", "serve", "catalog", "import"),
    "Check": ("verify", "repair", "doctor", "eval"),
}
"""Sections that only `list3r --all` shows."""


class GroupedCommands(typer.core.TyperGroup):
    """The commands in sections, each with the first sentence of its help."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write the list of commands."""
        for title, names in (FIRST | REST if ctx.params.get("everything") else FIRST).items():
            with formatter.section(title):
                formatter.write_dl([(n, self.commands[n].get_short_help_str(limit=300)) for n in names])


_BUILDING = ("build", "update", "demo", "precompute", "batch")
_INTERRUPTED = 130
"""Status that typer gives when Ctrl-C reaches it."""
_USAGE_ERROR: type[Exception] = typer.BadParameter.__mro__[1]
_COMMAND_ERROR: type[Exception] = typer.BadParameter.__mro__[2]


def main() -> None:
    """Run the command line and exit."""
    prepare_streams()
    os.environ.setdefault("OPENCV_LOG_LEVEL", "ERROR")  # errors of pictures are reported by us, in one line
    for name in ("SIGTERM", "SIGHUP"):
        if hasattr(signal, name) and signal.getsignal(getattr(signal, name)) is signal.SIG_DFL:
            signal.signal(getattr(signal, name), _interrupt)
    sys.exit(run(sys.argv[1:]))


def _interrupt(number: int, frame: FrameType | None) -> None:
    """Being ended is treated like Ctrl-C, so that nothing half-written stays behind."""
    raise KeyboardInterrupt


@functools.cache
def commands(asked: str | None = None) -> Any:
    """Return the tree of all commands and options, or the part for one command, as the whole takes long."""
    app = typer.Typer(
        name="list3r",
        cls=GroupedCommands,
        help="Object memory for long videos: build it, ask it, export it. Every command has --help with an example; "
        "list3r --all shows the commands that few people need.",
        no_args_is_help=True,
        rich_markup_mode=None,
        pretty_exceptions_enable=False,
        context_settings={"help_option_names": ["-h", "--help"]},
    )
    app.callback(invoke_without_command=True)(_options)
    one = any(asked in names for names in MODULES.values())
    for module, names in MODULES.items():
        if asked in names or not one:
            _add(app, importlib.import_module(f"list3r.cli.{module}"), names)
    return typer.main.get_command(app)


def _add(app: typer.Typer, module: ModuleType, names: Iterable[str]) -> None:
    """Add commands of a module to the program."""
    for name in names:
        found = getattr(module, FUNCTIONS.get(name, name.replace("-", "_")))
        if isinstance(found, typer.Typer):
            app.add_typer(found, name=name)
        else:
            app.command(name)(expanded(found))


def _options(
    context: typer.Context,
    everything: bool = typer.Option(False, "--all", help="Show all commands, also those that few people need."),
    version: bool = typer.Option(False, "--version", help="Print the version and exit."),
) -> None:
    if everything:
        say(*context.get_help().splitlines())
        raise typer.Exit
    if version:
        from list3r import __version__

        say(f"list3r {__version__}")
        raise typer.Exit


def run(arguments: list[str]) -> int:
    """Run one command; its exit status. What failed is said in one line, with `--json` in an answer as well."""
    with warnings.catch_warnings():
        warnings.showwarning = functools.partial(_show_warning, warnings.showwarning)
        warnings.simplefilter("default", MemoryFileWarning)
        return _run(arguments)


def _show_warning(
    others: Callable[..., None], message: Warning | str, category: type[Warning], *where: Any, **more: Any
) -> None:
    """Say what is to be known of a memory in one line; show any other warning as ever."""
    if issubclass(category, MemoryFileWarning):
        note(f"note: {message}")
    else:
        others(message, category, *where, **more)


def _run(arguments: list[str]) -> int:
    failures = _Failures(wants_json(arguments))
    try:
        if arguments and arguments[0] in _BUILDING:
            check_address_space(BUILD_MB, f"list3r {arguments[0]}")
        with naming_extras():
            program = commands(arguments[0] if arguments else None)
            status = program.main(arguments, prog_name="list3r", standalone_mode=False)
        flush()
        if status == _INTERRUPTED:
            raise KeyboardInterrupt
        return status if isinstance(status, int) else 0
    except _USAGE_ERROR as error:
        return failures.usage(error)
    except _COMMAND_ERROR as error:
        return failures.fail("OptionError", error.format_message())  # type: ignore[attr-defined]
    except List3rError as error:
        return _unwritten(error) if isinstance(error, OutputError) else failures.fail(type(error).__name__, str(error))
    except (KeyboardInterrupt, typer.Abort):
        note("", "interrupted")
        return 1
    except (SystemExit, BrokenPipeError) as stop:
        if not isinstance(stop, BrokenPipeError) and not isinstance(stop.__context__, BrokenPipeError):
            raise
        return _unheard()
    except (RuntimeError, OSError) as error:
        return failures.fail_of_system(error)
    except (MemoryError, ImportError) as error:
        return failures.fail_of_memory(error)


@dataclass(frozen=True)
class _Failures:
    """How a command that fails says so."""

    json: bool
    """Whether standard output gets an answer that holds the error."""

    def fail(self, kind: str, message: str) -> int:
        """Report an error of the input; exit status 2."""
        note(f"error: {message}")
        if self.json:
            print_error(kind, message, 2)
        return 2

    def fail_of_system(self, error: RuntimeError | OSError) -> int:
        """Errors of the system, and circular links, for which Python raises another error."""
        if isinstance(error, RuntimeError):
            if not str(error).startswith("Symlink loop"):
                raise error
            return self.fail("OSError", f"{error}; remove one of the links")
        where = f" {error.filename}:" if error.filename else ""
        return self.fail("OSError", f"{where} {error.strerror or error}".strip())

    def fail_of_memory(self, error: MemoryError | ImportError) -> int:
        """Out of memory, which loaded libraries report in their own way; exit status 1."""
        if isinstance(error, ImportError) and "failed to map" not in str(error):
            raise error
        message = "the process ran out of memory; raise its limit (ulimit -v, or that of the container)"
        self.fail("MemoryError", message)
        return 1

    def usage(self, error: BaseException) -> int:
        """An error of the command line, and the command's help."""
        from list3r.exporters.registry import FORMATS

        context = error.ctx  # type: ignore[attr-defined]
        message = error.format_message()  # type: ignore[attr-defined]
        if not message or message.startswith("Usage:"):
            note(*(message or context.get_help()).splitlines())
            return 2
        path = context.command_path if context is not None else "list3r"
        if (name := message.removeprefix("No such command '").rstrip("'.")) in FORMATS:
            message = f"{name} is a format: list3r export MEMORY --to {name} --out PATH"
        groups = {} if context is None else getattr(context.command, "commands", {})
        if (group := next((g for g, c in groups.items() if name in getattr(c, "commands", {})), None)) is not None:
            message = f"{name} belongs to {group}: list3r {group} {name}"
        return self.fail("OptionError", f"{message.rstrip('.')}; see `{path} --help`")


def _unwritten(error: OutputError) -> int:
    mute()
    note(f"error: {error}")
    return 1


def _unheard() -> int:
    """Whoever read the output has heard enough, as in `list3r list house.l3r | head -1`: that is no failure."""
    mute()
    return 0
