"""The main job through the real program: build, resume after a kill, interrupt, and the same result every time."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import list3r
from list3r.evaluation.trajectory import Trajectory, evaluate_trajectory, read_tum
from list3r.frames.chunking.chunks import ChunkSettings, plan_chunks
from list3r.memory.core.errors import OptionError
from list3r.memory.store.store import Store
from list3r.simulation.dataset import WalkSettings, write_walk
from tests.program import in_process, with_signals

OPTIONS = ("--chunk", "10", "--overlap", "3")


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short simulated walk: three chunks of ten frames."""
    settings = WalkSettings(seed=3, frames=24, size=(192, 144))
    return write_walk(tmp_path_factory.mktemp("walk") / "walk", settings, workers=1)


def start(walk: Path, memory: Path, *more: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "list3r", "build", str(walk), "-m", str(memory), *OPTIONS, *more]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, preexec_fn=with_signals)


def build(walk: Path, memory: Path, *more: str) -> None:
    """The program in this process."""
    done = in_process("build", walk, "-m", memory, *OPTIONS, "--workers", "0", *more)
    assert done.returncode == 0, done.stderr


@pytest.fixture(scope="module")
def memory(walk: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The memory of the walk with estimated poses, built in one go by two workers."""
    path = tmp_path_factory.mktemp("memory") / "rooms.l3r"
    process = start(walk, path, "--poses", "estimate", "--workers", "2")
    _, err = process.communicate(timeout=300)
    assert process.returncode == 0, err
    return path


def content(path: Path) -> dict[str, Any]:
    """All that a user can see of a memory."""
    with Store.open(path) as store:
        poses = store.trajectory.poses()
        return {
            "frames": [(f.frame_index, f.state) for f in store.frames.all()],
            "poses": np.stack([S.as_matrix() for _, S in poses]),
            "instances": [(i.id, i.description, i.observations, i.structure, i.state) for i in store.instances.all()],
            "boxes": np.array([[*i.center, *i.box.size, *i.aabb.ravel()] for i in store.instances.all()]),
            "relations": [(r.subject, r.predicate, r.object) for r in store.relations.all()],
            "aliases": store.ids.aliases(),
            "decisions": [(d.kind, d.a, d.b, d.reason) for d in store.merges.decisions()],
        }


def check_same(a: Path, b: Path) -> None:
    left, right = content(a), content(b)
    for key, value in left.items():
        if isinstance(value, np.ndarray):
            assert value.shape == right[key].shape, key
            assert np.allclose(value, right[key], atol=1e-9), key
        else:
            assert value == right[key], key


def finished_chunks(memory: Path) -> int:
    try:
        with Store.open(memory) as store:
            return len(store.chunks.all())
    except list3r.List3rError:
        return 0


def test_the_camera_is_followed_and_things_are_found(walk: Path, memory: Path) -> None:
    with Store.open(memory) as store:
        assert store.verify() == []
        assert store.sessions.all()[0].state == "complete"
        poses = store.trajectory.poses()
        assert len(poses) == 24
        estimate = Trajectory(np.array([f.time_s for f, _ in poses]), np.stack([S.as_matrix() for _, S in poses]))
        assert evaluate_trajectory(read_tum(walk / "groundtruth.txt"), estimate).ate_se3_m.rmse < 0.03
        assert len(store.instances.all(structure=False)) >= 4
        assert store.facts.gravity == "estimated"


def test_a_killed_build_is_sound_and_resumes_to_the_same_memory(walk: Path, memory: Path, tmp_path: Path) -> None:
    path = tmp_path / "killed.l3r"
    process = start(walk, path, "--poses", "estimate", "--workers", "1")
    deadline = time.monotonic() + 300
    while finished_chunks(path) < 2 and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.05)
    process.kill()
    process.communicate()
    with Store.open(path) as store:
        assert store.verify() == []
        assert 2 <= len(store.chunks.all()) < 3
        assert store.sessions.all()[0].state == "building"
    build(walk, path, "--poses", "estimate", "--resume")
    check_same(path, memory)


@pytest.mark.slow
def test_ctrl_c_ends_at_once_and_says_how_to_go_on(walk: Path, memory: Path, tmp_path: Path) -> None:
    path = tmp_path / "interrupted.l3r"
    process = start(walk, path, "--poses", "estimate", "--workers", "2")
    deadline = time.monotonic() + 300
    while finished_chunks(path) < 1 and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 1
    assert "--resume" in err and "Traceback" not in err
    build(walk, path, "--poses", "estimate", "--resume")
    check_same(path, memory)


def test_the_number_of_workers_does_not_change_the_memory(walk: Path, memory: Path, tmp_path: Path) -> None:
    build(walk, tmp_path / "none.l3r", "--poses", "estimate")
    check_same(tmp_path / "none.l3r", memory)


def test_given_poses_are_kept(walk: Path, tmp_path: Path) -> None:
    settings = list3r.BuildSettings(poses="given", chunks=ChunkSettings(10, 3))
    with list3r.build(walk, tmp_path / "given.l3r", settings=settings, workers=0) as memory:
        poses = memory.store.trajectory.poses()
        estimate = Trajectory(np.array([f.time_s for f, _ in poses]), np.stack([S.as_matrix() for _, S in poses]))
        assert evaluate_trajectory(read_tum(walk / "groundtruth.txt"), estimate).ate_se3_m.rmse < 1e-3
        assert memory.nearest((0.0, 0.0, 1.0), k=2)


def test_resume_with_other_settings_is_refused(walk: Path, memory: Path) -> None:
    with pytest.raises(OptionError, match="chunks"):
        list3r.build(walk, memory, settings=list3r.BuildSettings(poses="estimate"), resume=True)


@pytest.mark.parametrize("count", [1, 12, 13, 40, 41, 68, 69, 1000])
def test_chunks_cover_every_frame_and_share_the_overlap(count: int) -> None:
    spans = plan_chunks(count, ChunkSettings(40, 12))
    assert spans[0].start == 0 and spans[-1].stop == count
    assert all(a.stop - b.start == 12 for a, b in pairwise(spans))
    assert all(b.stop > a.stop for a, b in pairwise(spans))
