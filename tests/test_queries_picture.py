"""Things like what a picture shows."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

import list3r
from list3r.cli.app import run
from list3r.instances.geometric.features import COLOR_PART, color_feature, object_feature
from list3r.instances.settings import FEATURE_SPACE
from list3r.memory.core.errors import OptionError, SourceError
from list3r.memory.store.store import Store

Make = Callable[..., Path]
COLORS = {2: (150, 110, 70), 3: (200, 30, 30), 4: (30, 40, 200), 5: (240, 240, 240)}


@pytest.fixture
def path(make_memory: Make) -> Path:
    """The small room, its things in four colours."""
    made = make_memory()
    rng = np.random.default_rng(0)
    up = np.array([0.0, 0.0, 1.0])
    with Store.open(made, writable=True) as store, store.transaction():
        for n, color in COLORS.items():
            points = rng.random((300, 3)).astype(np.float32)
            store.embeddings.put(FEATURE_SPACE, [n], object_feature(points, noisy(color, 300), up, 1.0)[None])
    return made


def noisy(rgb: tuple[int, int, int], count: int) -> np.ndarray:
    rng = np.random.default_rng(1)
    return np.clip(np.array(rgb) + rng.normal(0, 6, (count, 3)), 0, 255).astype(np.uint8)


def picture() -> np.ndarray:
    """Red on blue, side by side. Shape (60, 120, 3)."""
    return np.concatenate([noisy(COLORS[n], 3600).reshape(60, 60, 3) for n in (3, 4)], axis=1)


def test_the_part_of_a_box_is_compared_by_its_colours(path: Path) -> None:
    with list3r.open(path) as memory:
        red = memory.similar_to_picture(picture(), box_xyxy=(5, 5, 55, 55))
        blue = memory.similar_to_picture(picture(), box_xyxy=(65, 5, 115, 55))
        assert (red[0].instance.id, blue[0].instance.id) == (3, 4)
        assert red[0].score > 0.98 > red[1].score and "colours alone" in red[0].reason
        assert [m.score for m in red] == sorted((m.score for m in red), reverse=True)
        assert [m.instance.id for m in memory.similar_to_picture(picture(), k=9, color="none so")] == []


def test_colours_of_a_feature_are_its_first_numbers() -> None:
    rgb = noisy((30, 160, 40), 500)
    whole = object_feature(np.random.default_rng(2).random((500, 3)).astype(np.float32), rgb, np.eye(3)[2], 1.0)
    head = whole[:COLOR_PART] / np.linalg.norm(whole[:COLOR_PART])
    assert np.allclose(head, color_feature(rgb), atol=1e-5)


def test_the_command_takes_a_file(path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "p.png"
    cv2.imwrite(str(file), picture()[:, :, ::-1])
    assert run(["similar", str(path), "--image", str(file), "--box", "60,0,120,60", "-k", "1"]) == 0
    assert capsys.readouterr().out.splitlines()[1].startswith("4 ")


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["--id", "3", "--image", "x.png"],
        ["--id", "3", "--box", "1,2,3,4"],
        ["--image", "nothing.png"],
        ["--image", "{path}"],
        ["--image", "{file}", "--box", "0,0,500,5"],
        ["--image", "{file}", "--box", "5,5,5,9"],
        ["--image", "{file}", "--box", "nan,0,3,3"],
        ["--image", "{file}", "--box", "a"],
    ],
)
def test_what_makes_no_sense_is_one_line(
    arguments: list[str], path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "p.png"
    cv2.imwrite(str(file), picture()[:, :, ::-1])
    words = [a.format(path=path, file=file) for a in arguments]
    assert run(["similar", str(path), *words]) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1


def test_a_memory_without_vectors_says_so(make_memory: Make) -> None:
    with list3r.open(make_memory()) as memory:
        with pytest.raises(OptionError, match="list3r embed"):
            memory.similar_to_picture(picture())
        with pytest.raises(SourceError, match="cannot be read"):
            memory.similar_to_picture("nothing.png")
