"""Stored pictures, and the one that shows an instance best."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import list3r
from list3r.cli.app import run
from list3r.memory.core.errors import OptionError, UnknownIdError
from list3r.memory.core.geometry import Sim3
from list3r.memory.core.records import Observation
from list3r.memory.store.store import Store
from tests.conftest import box_points, chunk_result, instance, local_instance, small_picture, write_small_room

MUG = 3


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("pictures") / "room.l3r"
    with Store.create(path) as store, store.transaction():
        write_small_room(store, small_picture())
    return path


def test_a_picture_says_what_shows_in_it(room: Path) -> None:
    with list3r.open(room) as memory:
        (picture,) = memory.pictures()
        assert (picture.session_id, picture.frame_index, picture.image_size) == (1, 0, (48, 64))
        assert [s.instance_id for s in picture.sights] == [1, 2, 3, 4, 5, 6]
        assert [s.instance_id for s in memory.pictures([MUG])[0].sights] == [MUG]
        assert memory.pixels(picture).shape == (48, 64, 3)


def test_the_picture_of_an_instance_has_its_mask_and_box(room: Path) -> None:
    with list3r.open(room) as memory:
        found = memory.picture(MUG)
        assert found.mask is not None and found.mask.sum() == 20 and found.mask[20, 10:30].all()
        assert found.box_xyxy == (10.0, 20.0, 30.0, 30.0)
        crop = found.crop(margin=0.0)
        assert crop.shape[:2] == (18, 28) and (crop == found.rgb[16:34, 6:34]).all()
        assert (found.marked() != found.rgb).any() and found._repr_png_().startswith(b"\x89PNG")


def test_what_was_followed_in_no_keyframe_is_projected(tmp_path: Path) -> None:
    path = tmp_path / "room.l3r"
    with Store.create(path) as store, store.transaction():
        chunk = store.chunks.add(store.sessions.add("walk", "a", {}, 20), chunk_result(0, 0, 20, (), small_picture()))
        store.chunks.place({chunk: Sim3.identity()}, {chunk: chunk})
        store.instances.put([instance(7, (1.2, 0.3, 0.3), (0.2, 0.2, 0.2), (9, 9, 9))])
    with list3r.open(path) as memory:
        found = memory.picture(7)
        assert found.mask is None and found.frame_index == 0
        x0, y0, x1, y1 = found.box_xyxy
        # It stands 1.2 m ahead, 0.3 m to the left and as high above the camera, whose focal length is 60 px.
        assert x0 < 32.0 - 60.0 * 0.25 < x1 and y0 < 24.0 - 60.0 * 0.25 < y1


def test_without_pictures_it_is_said(tmp_path: Path) -> None:
    path = tmp_path / "room.l3r"
    with Store.create(path) as store, store.transaction():
        write_small_room(store)
    with list3r.open(path) as memory:
        assert memory.pictures() == []
        with pytest.raises(OptionError, match=r"no stored picture .* shows instance 3"):
            memory.picture(MUG)
        with pytest.raises(UnknownIdError):
            memory.picture(99)


def test_the_command_writes_it(room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "mug.png"
    assert run(["picture", str(room), str(MUG), "--out", str(out), "--json"]) == 0
    (told,) = json.loads(capsys.readouterr().out)["matches"]
    assert told["frame"] == 0 and told["followed"] and told["path"] == str(out)
    assert Image.open(out).size == (30, 20)
    assert run(["picture", str(room), str(MUG), "--out", str(out), "--whole"]) == 0
    assert np.asarray(Image.open(out)).shape == (48, 64, 3)
    assert run(["picture", str(room), str(MUG), "--out", str(tmp_path / "mug.tiff")]) == 2
    assert ".jpg or .png" in capsys.readouterr().err


def test_the_picture_shows_most_of_what_is_known_of_it(tmp_path: Path) -> None:
    path = tmp_path / "room.l3r"
    with Store.create(path) as store, store.transaction():
        session = store.sessions.add("walk", "a", {}, 40)
        for index, count in enumerate((20, 400)):  # the first chunk saw a corner of it
            points = box_points((1.0, 0.0, 0.5), (0.3, 0.3, 0.3), count, index)
            local = local_instance(0, points, (200, 80, 40), np.array([20 * index]))
            made = chunk_result(index, 20 * index, 20, (local,), small_picture())
            chunk = store.chunks.add(session, made)
            store.chunks.place({chunk: Sim3.identity()}, {chunk: chunk})
        store.instances.put([instance(7, (1.0, 0.0, 0.5), (0.3, 0.3, 0.3), (200, 80, 40))])
        store.observations.set([Observation(7, 1, 0), Observation(7, 2, 0)])
    with list3r.open(path) as memory:
        assert memory.picture(7).frame_index == 20
