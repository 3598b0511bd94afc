"""Random command lines made from the real options, over a folder of good, bad and strange files.

Each ends with status 0, 1 or 2, without a traceback, within the time and memory of `asking`. What would serve for ever
is interrupted. Home and caches lie in the folder, and nothing is fetched.
"""

from __future__ import annotations

import contextlib
import os
import random
import shutil
from functools import cache
from pathlib import Path
from typing import Any

from hostile.asking import ask, warm_up
from hostile.subject import write_source, write_subject
from hostile.work import Batch, Tally
from list3r.cli.app import commands
from list3r.exporters.registry import FORMATS

EACH = 50
BUILDS_S = 60.0
"""Processor time of a command that builds; of all others it is that of `asking`."""
_BUILDING = {"build", "update", "demo", "precompute", "batch", "convert", "inspect", "detect", "embed"}
_SERVING = {"view", "mcp", "serve"}
_RARE = {"demo", "view", "mcp", "batch", "build", "update", "precompute"}
_NUMBERS = ("0", "1", "2", "3", "-1", "0.5", "nan", "inf", "-inf", "1e400", "99999999999999999999", "0x10", "")
_TEXTS = ("", "x", "white box on table", "é", "\x1b[2J", "a\nb", "\udce9", "'; DROP TABLE instances; --", "a" * 5000)
_LISTS = ("0,0,1", "1,2", "0,0,0,0,0,0,0", "0,0,1,1,0,0,0", "nan,0,0", "1,1,1,0,0,0", ",", "0,0,0,1,1,1", "50,50,32,24")
_PATHS = (
    "sound.l3r",
    "sound.l3r",
    "damaged.l3r",
    "empty.l3r",
    "folder",
    "walk",
    "walk",
    "walk/rgb",
    "walk/rgb.txt",
    "walk/groundtruth.txt",
    "picture.jpg",
    "half.png",
    "pipe",
    "circle",
    "no such file",
    "no/such/folder/x.json",
    "line\nend.l3r",
    "\udce9.l3r",
    "/dev/null",
    "/dev/full",
    "/dev/zero",
    "",
    ".",
    "out.json",
    "out.usda",
    "new.l3r",
)
_WORDS = ("rgbd", "sfm", "given", "estimate", "prior", "tum", "images", "video", "learned", "eomt", "cpu", "cuda")
_WORDS += ("on", "left_of", "between", "any", "present", "white", "camera", "commercial", "research", "icp", "none")


def batch(folder: Path, first_seed: int, n: int) -> Batch:
    """Run the command lines of one batch, each in the folder as those before it left it."""
    template = _template(folder)
    here = template.with_name("here")
    shutil.rmtree(here, ignore_errors=True)
    shutil.copytree(template, here, symlinks=True, copy_function=_copy)
    os.chdir(here)
    tally = Tally()
    for k in range(n * EACH, (n + 1) * EACH):
        words = command_line(random.Random(f"{first_seed}:{k}"))
        most = BUILDS_S if words[0] in _BUILDING else None
        tally.add("", repr(words), ask(words, longest_s=most, serves=words[0] in _SERVING))
    os.chdir(folder)
    return tally.batch(EACH)


def command_line(rng: random.Random) -> list[str]:
    """Return a command with some of its options, most of them with values of their kind."""
    path, command = rng.choice(_commands())
    words = list(path)
    for parameter in command.params:
        optional = parameter.param_type_name == "option" or not parameter.required
        if parameter.opts and "--help" in parameter.opts:
            continue
        if optional and not parameter.required and rng.random() > 0.2:
            continue
        if rng.random() < 0.03:
            continue
        if parameter.param_type_name == "option":
            words.append(rng.choice((*parameter.opts, *parameter.secondary_opts)))
        if not getattr(parameter, "is_flag", False):
            words.append(_value(parameter, rng))
    if path[0] in ("build", "update", "demo"):
        words += ["--workers", "0"] + (["--frames", rng.choice(("2", "3"))] if path[0] == "demo" else [])
    return words if rng.random() > 0.03 else [*words, rng.choice(("--nonsense", "more", "--json", "-h"))]


def _value(parameter: Any, rng: random.Random) -> str:
    name = (parameter.opts[-1] if parameter.opts else str(parameter.name)).lstrip("-")
    if rng.random() < 0.1:
        return str(rng.choice((*_NUMBERS, *_TEXTS, *_LISTS, *_PATHS)))
    kind = f"{name} {parameter.metavar or ''}".lower()
    if name in ("name", "to"):
        return str(rng.choice(_TEXTS if name == "name" else (*FORMATS, "nonsense")))
    if name in ("memory", "source"):
        return str(rng.choice(_PATHS)) if rng.random() < 0.5 else "sound.l3r" if name == "memory" else "walk"
    if any(
        word in kind for word in ("file", "dir", "path", "trajectory", "truth", "estimate", "where", "videos", "folder")
    ):
        return str(rng.choice(_PATHS))
    if "," in kind:
        return str(rng.choice(_LISTS))
    if name in ("a", "b", "start", "end", "id", "entry") or "id" in kind.split():
        return str(rng.choice((*_NUMBERS[:5], "2", "3", "5")))
    if any(word in name for word in ("text", "words", "label", "question", "author", "anchor")):
        return str(rng.choice((*_TEXTS, "2=0.1m", "camera_height=1.5m")))
    return str(rng.choice((*_NUMBERS, *_NUMBERS[:5], *_WORDS)))


@cache
def _commands() -> tuple[tuple[tuple[str, ...], Any], ...]:
    """Return all commands; slow ones once, all others four times."""
    found: list[tuple[tuple[str, ...], Any]] = []

    def walk(command: Any, path: tuple[str, ...]) -> None:
        for name, inner in getattr(command, "commands", {}).items():
            walk(inner, (*path, name))
        if not hasattr(command, "commands"):
            found.extend([(path, command)] * (1 if path[0] in _RARE else 4))

    walk(commands(), ())
    return tuple(found)


@cache
def _template(folder: Path) -> Path:
    """Make the folder that command lines are about, and a home in it."""
    home = folder / f"home-{os.getpid()}"
    made = home / "template"
    (made / "folder").mkdir(parents=True)
    os.environ |= {"HOME": str(home), "HF_HOME": str(home / "hf"), "XDG_CACHE_HOME": str(home / "cache")}
    os.environ |= {"HF_HUB_OFFLINE": "1", "XDG_CONFIG_HOME": str(home / "config")}
    sound = write_subject(made / "sound.l3r")
    data = sound.read_bytes()
    (made / "damaged.l3r").write_bytes(data[:200_000] + bytes(8192) + data[208_192:])
    (made / "line\nend.l3r").write_bytes(data)
    (made / "\udce9.l3r").write_bytes(data)
    (made / "empty.l3r").touch()
    write_source(made / "walk")
    picture = next((made / "walk" / "rgb").iterdir())
    shutil.copy(picture, made / "picture.jpg")
    (made / "half.png").write_bytes(picture.read_bytes()[:200])
    os.mkfifo(made / "pipe")
    (made / "circle").symlink_to("circle")
    warm_up(sound, home, ())
    return made


def _copy(source: str, target: str) -> None:
    if os.path.basename(source) == "pipe":  # noqa: PTH119
        os.mkfifo(target)
    else:
        with contextlib.suppress(OSError):
            shutil.copy2(source, target)
