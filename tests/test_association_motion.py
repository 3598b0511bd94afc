"""Motion inside a chunk: what moves is flagged with where it was, what stands still never is."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from list3r.association.overlap.motion import flag_dynamic, motion_track, seen_through
from list3r.frames.base import Frame
from list3r.frames.source import SourceOptions, open_source
from list3r.instances.library import build_library
from list3r.memory.core.geometry import Sim3
from list3r.memory.core.records import FrameSamples, LocalLibrary
from list3r.reconstruction.keyframe_record import frame_samples
from list3r.reconstruction.rgbd.reconstructor import RgbdReconstructor
from tests.association_scenes import BOX, BOXES, CAMERA, MOVER, Thing, film, library_of

GAUGE = Sim3.exp([0.4, -0.2, 0.7, 0.3, -0.5, 0.2, 0.4])


def moving(samples: FrameSamples) -> list[int]:
    flagged = flag_dynamic(samples, library_of(samples), CAMERA)
    return [i.local_id for i in flagged.instances if i.dynamic]


def test_a_calm_walk_has_no_mover() -> None:
    assert moving(film(noise=0.01)) == []
    assert moving(film(S_chunk_world=GAUGE, noise=0.01, seed=1)) == []


@pytest.mark.parametrize("speed", [(0.05, 0.0, 0.0), (0.0, 0.0, 0.05), (0.0, 0.0, -0.05)])
def test_what_moves_is_found_also_along_the_ray(speed: tuple[float, float, float]) -> None:
    samples = film((*BOXES, Thing(MOVER, (-0.2, 0.3, 2.2), (0.2, 0.4), speed)), GAUGE, noise=0.005)
    assert moving(samples) == [MOVER]


def test_its_track_is_where_it_was() -> None:
    thing = Thing(MOVER, (-0.5, 0.2, 2.0), (0.2, 0.4), (0.05, 0.0, 0.0))
    samples = film((*BOXES, thing), GAUGE, noise=0.005)
    flagged = flag_dynamic(samples, library_of(samples), CAMERA)
    motion = next(i.motion for i in flagged.instances if i.local_id == MOVER)
    assert motion is not None
    true = GAUGE.apply(np.array(thing.center) + motion.frames[:, None] * np.array(thing.speed))
    off = np.linalg.norm(motion.positions - true, axis=1) / float(GAUGE.scale)
    assert len(motion.frames) >= 15
    assert np.median(off) < 0.05


def test_a_mover_over_half_of_the_picture_does_not_make_the_room_move() -> None:
    samples = film((*BOXES, Thing(MOVER, (-1.4, 0.2, 2.0), (0.9, 1.2), (0.09, 0.0, 0.0))), noise=0.005)
    assert moving(samples) == [MOVER]


def test_two_things_that_are_seen_in_turn_do_not_move() -> None:
    """One track that changes hands between twins."""
    samples = film(noise=0.005)
    early = samples.frame < 12
    instance = np.where(samples.instance == 4, np.where(early, -1, BOX), samples.instance)
    instance = np.where((samples.instance == BOX) & ~early, -1, instance).astype(np.int32)
    assert moving(replace(samples, instance=instance)) == []


def test_a_mask_that_leaks_is_no_mover() -> None:
    samples = film(noise=0.005)
    rng = np.random.default_rng(0)
    leaked = (samples.instance != BOX) & (rng.random(len(samples.frame)) < 0.2)
    assert moving(replace(samples, instance=np.where(leaked, BOX, samples.instance).astype(np.int32))) == []


def test_what_something_else_hides_does_not_move() -> None:
    passing = Thing(MOVER, (-1.6, 0.2, 1.6), (0.3, 1.0), (0.1, 0.0, 0.0))
    assert moving(film((*BOXES, passing), noise=0.005)) == [MOVER]


def test_nothing_to_judge_is_no_mover() -> None:
    empty = LocalLibrary((), np.zeros((0, 2), np.int32), "test@1/4")
    assert flag_dynamic(FrameSamples.empty(), empty, CAMERA).instances == ()
    samples = film(noise=0.005)
    library = library_of(samples)
    assert not seen_through(FrameSamples.empty(), library, CAMERA).any()
    spoilt = replace(samples, points=np.full_like(samples.points, np.nan))
    assert not seen_through(spoilt, library, CAMERA).any()
    assert motion_track(spoilt, library.instances[0]) is None
    one = replace(film(frames=1), instance=film(frames=1).instance)
    assert not seen_through(one, library_of(one), CAMERA).any()


def test_what_is_flagged_stays_flagged() -> None:
    samples = film()
    library = library_of(samples)
    known = replace(library, instances=tuple(replace(i, dynamic=i.local_id == BOX) for i in library.instances))
    flagged = flag_dynamic(samples, known, CAMERA)
    assert [i.local_id for i in flagged.instances if i.dynamic] == [BOX]
    assert next(i for i in flagged.instances if i.dynamic).motion is not None


@pytest.mark.slow
@pytest.mark.data
@pytest.mark.parametrize("name", ["redkitchen", "cabinet"])
def test_real_rooms_in_which_nothing_moves_have_no_mover(name: str) -> None:
    place = Path(__file__).parents[2] / "shared" / "data" / name
    if not place.exists():
        pytest.skip(f"needs {place}")
    source = open_source(str(place), SourceOptions())
    camera = source.info.camera
    assert camera is not None
    frames = [f for f in source.read(0, 24) if isinstance(f, Frame)]
    reconstruction = RgbdReconstructor(poses="estimate")(frames, camera)
    library = build_library(frames, reconstruction)
    flagged = flag_dynamic(frame_samples(reconstruction, library), library, reconstruction.camera)
    assert len(flagged.instances) >= 3
    assert not any(i.dynamic for i in flagged.instances)
