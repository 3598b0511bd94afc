"""The eval commands, the loops of info and the loops on the plan through the real program."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from list3r.evaluation.covisibility import Covisibility, write_covisibility
from list3r.evaluation.trajectory import Trajectory, write_tum
from list3r.frames.base import Frame
from list3r.frames.folder import FolderSource
from list3r.frames.source import open_source
from list3r.memory.core.geometry import Sim3
from list3r.memory.core.records import Edge
from list3r.memory.store.store import Store
from tests.conftest import chunk_result, write_small_room
from tests.program import in_process as run
from tests.test_cli_errors import check_refused, write_frames

CHUNKS = 5
LOOPS = (
    ((1, 4), (2, 33), True, "41 features agree, 63% seen by both", {"s_det": 0.82, "s_sem": 0.9, "s_rel": 0.7}),
    ((2, 4), (12, 35), False, "only 3 of 43 matched features agree on a pose", {"s_det": 0.91, "s_sem": 0.2}),
)


def write_walk_memory(path: Path, parts: int = 1) -> None:
    """Five chunks of twelve frames, two of them shared; a camera on a circle; an accepted and a rejected loop."""
    with Store.create(path) as store, store.transaction():
        session = store.sessions.add("walk", "abc", {}, 52)
        placed, components, covariances = {}, {}, {}
        for k in range(CHUNKS):
            chunk = store.chunks.add(session, chunk_result(k, 10 * k, 12, ()))
            angle = 2 * np.pi * k / CHUNKS
            placed[chunk] = Sim3.exp(np.array([np.cos(angle), np.sin(angle), 0, 0, 0, angle / 2, 0]))
            components[chunk] = 1 if parts == 1 or k < 3 else 4
            covariances[chunk] = np.eye(7) * (0.01 * k) ** 2
        store.chunks.place(placed, components, covariances)
        store.edges.add(
            Edge(k, k + 1, "adjacent", Sim3.identity(), 0.9, 0.5 + 0.1 * k, 300, 0.004, True, "shared frames agree")
            for k in range(1, CHUNKS)
        )
        store.edges.add(
            Edge(u, v, "loop", Sim3.identity(), 0.8, 0.4, 900 * good, 0.012 * good, good, reason, scores, frames)
            for (u, v), frames, good, reason, scores in LOOPS
        )
        store.facts.scale_kind, store.facts.scale_source = "metric", "sensor depth"
        store.facts.gravity = "estimated"
        store.sessions.complete(session)


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Truths and results, good and bad."""
    root = tmp_path_factory.mktemp("eval")
    with Store.create(root / "room.l3r") as store, store.transaction():
        write_small_room(store)
    write_walk_memory(root / "walk.l3r")
    with Store.open(root / "walk.l3r") as store:
        poses = [(f.time_s, S.as_matrix()) for f, S in store.trajectory.poses()]
    write_walk_memory(root / "parts.l3r", parts=2)
    with Store.create(root / "empty.l3r") as store, store.transaction():
        store.sessions.complete(store.sessions.add("walk", "abc", {}, 0))
    bent = np.stack([T for _, T in poses])
    bent[:, 0, 3] += 0.02 * np.sin(np.arange(52))
    write_tum(root / "walk.txt", Trajectory(np.array([t for t, _ in poses]), bent))
    write_tum(root / "late.txt", Trajectory(np.array([t + 900 for t, _ in poses]), bent))
    frame = np.arange(0, 52, 2)
    gap = np.abs(np.subtract.outer(frame % 31, frame % 31))
    share = np.where(gap < 6, 0.9, 0.0).astype(np.float32)
    write_covisibility(root / "walk.npz", Covisibility(frame, frame / 30, share))
    write_covisibility(root / "other.npz", Covisibility(frame + 5000, frame / 30, share))
    write_covisibility(root / "slow.npz", Covisibility(frame, frame * 1.0, share))
    np.savez(root / "zeros.npz", x=np.zeros(3))
    write_frames(root / "good")
    write_frames(root / "unposed", poses=False)
    (root / "note.txt").write_text("hello")
    (root / "note.doc").write_text("hello")
    (root / "bad.ply").write_text("hello")
    (root / "none.xyz").touch()
    (root / "few.txt").write_text("0 0 0 0 0 0 0 1\n")
    (root / "blank.json").write_text("{}")
    (root / "folder").mkdir()
    (root / "folder.png").mkdir()
    export(root, "ply", "room.ply")
    scene = json.loads(export(root, "json", "room.json").read_text())
    (root / "truth").mkdir()
    truth = {
        "instances": [{**i, "label": f"thing {i['id']}"} for i in scene["instances"]],
        "relations": scene["relations"],
    }
    (root / "truth/truth.json").write_text(json.dumps(truth))
    return root


def export(root: Path, name: str, file: str) -> Path:
    result = run("export", root / "room.l3r", "--to", name, "--out", root / file)
    assert result.returncode == 0, result.stderr
    return root / file


def ask(*words: str | Path) -> Any:
    result = run(*words, "--json")
    assert result.returncode == 0, result.stderr
    (match,) = json.loads(result.stdout)["matches"]
    return match


def read(*words: str | Path) -> str:
    result = run(*words)
    assert result.returncode == 0, result.stderr
    return result.stdout


CASES = {
    "trajectory of nothing": ("trajectory {p}/absent.txt {p}/walk.l3r", "absent.txt"),
    "trajectory that is none": ("trajectory {p}/note.txt {p}/walk.l3r", "note.txt holds no poses; expected lines of"),
    "trajectory of another time": ("trajectory {p}/late.txt {p}/walk.l3r", "0 poses within.*one clock"),
    "trajectory of one pose": ("trajectory {p}/few.txt {p}/walk.l3r", "poses within"),
    "memory without poses": ("trajectory {p}/walk.txt {p}/empty.l3r", "no frame with a pose.*--resume"),
    "source without poses": ("trajectory {p}/unposed {p}/walk.l3r", "no poses"),
    "delta of no unit": ("trajectory {p}/walk.txt {p}/walk.l3r --delta 3km", "delta '3km'.*0.5m or 2s"),
    "delta too great": ("trajectory {p}/walk.txt {p}/walk.l3r --delta 900", "900 frames apart"),
    "picture of no kind": ("trajectory {p}/walk.txt {p}/walk.l3r --plot {p}/a.jpg", r"a.jpg.*\.png, \.pdf or \.svg"),
    "picture in no folder": ("trajectory {p}/walk.txt {p}/walk.l3r --plot {p}/no/a.png", "no.*does not exist"),
    "picture onto a folder": ("cloud {p}/room.ply {p}/room.l3r --plot {p}/folder.png", "folder.png is a folder"),
    "scale of no kind": ("trajectory {p}/walk.txt {p}/walk.l3r --scale big", "'big' is not one of"),
    "cloud of nothing": ("cloud {p}/absent.ply {p}/room.l3r", "absent.ply does not exist"),
    "cloud of another ending": ("cloud {p}/note.doc {p}/room.l3r", "note.doc ends in .doc"),
    "cloud that is none": ("cloud {p}/bad.ply {p}/room.l3r", "bad.ply cannot be read"),
    "cloud without points": ("cloud {p}/none.xyz {p}/room.l3r", "none.xyz"),
    "memory without surface": ("cloud {p}/room.ply {p}/walk.l3r", "no surface point"),
    "cloud of a source without poses": ("cloud {p}/unposed {p}/room.l3r", "no poses"),
    "cloud aligned by nothing": ("cloud {p}/room.ply {p}/room.l3r --align {p}/absent.txt", "absent.txt"),
    "cloud without a path": ("cloud {p}/room.ply {p}/room.ply --align {p}/walk.txt", "no camera path.*--path"),
    "threshold zero": ("cloud {p}/room.ply {p}/room.l3r --threshold 0", "--threshold 0"),
    "negative voxel": ("cloud {p}/room.ply {p}/room.l3r --voxel=-1", "voxel -1"),
    "no points wanted": ("cloud {p}/room.ply {p}/room.l3r --points 0", "points 0"),
    "instances of nothing": ("instances {p}/absent.json {p}/room.l3r", "absent.json"),
    "instances of no scene": ("instances {p}/blank.json {p}/room.l3r", "blank.json has no list of instances"),
    "ids in no folder": ("instances {p}/truth/truth.json {p}/room.l3r --ids {p}/absent", "absent is not a folder"),
    "ids without masks": ("instances {p}/truth/truth.json {p}/room.json --ids {p}/folder", "no masks"),
    "ids in an empty folder": ("instances {p}/truth/truth.json {p}/room.l3r --ids {p}/folder", "no pictures of true"),
    "ids of every zeroth frame": (
        "instances {p}/truth/truth.json {p}/room.l3r --every 0",
        "--every.*greater than or equal to 1",
    ),
    "instances of another time": ("instances {p}/truth/truth.json {p}/room.l3r --align {p}/late.txt", "0 poses within"),
    "revisits of nothing": ("revisits {p}/absent.npz {p}/walk.l3r", "absent.npz"),
    "revisits of another array": ("revisits {p}/zeros.npz {p}/walk.l3r", "zeros.npz has no array frame"),
    "revisits of another video": ("revisits {p}/other.npz {p}/walk.l3r", "none of its 26 frames is in the memory"),
    "revisits of another clock": ("revisits {p}/slow.npz {p}/walk.l3r", "is it the source of the memory"),
    "revisits of no memory": ("revisits {p}/walk.npz {p}/note.txt", "not a memory"),
    "revisits of no session": ("revisits {p}/walk.npz {p}/walk.l3r --session 9", "no session 9"),
    "revisits of a source without poses": ("revisits {p}/unposed {p}/walk.l3r", "no poses"),
    "revisits of absurd shares": (
        "revisits {p}/walk.npz {p}/walk.l3r --least 0.1 --different 0.5",
        "different <= least",
    ),
    "covisibility of another ending": ("revisits {p}/walk.npz {p}/walk.l3r --save {p}/a.txt", "must end in .npz"),
}


@pytest.mark.parametrize("case", CASES)
def test_bad_input_is_refused_in_one_line_and_leaves_nothing(case: str, place: Path) -> None:
    command, pattern = CASES[case]
    before = {p: p.stat().st_mtime_ns for p in place.iterdir() if p.is_file()}
    check_refused(run("eval", *(word.format(p=place) for word in command.split())), pattern)
    assert {p: p.stat().st_mtime_ns for p in place.iterdir() if p.is_file()} == before


@pytest.mark.parametrize("command", ["trajectory", "cloud", "instances", "revisits"])
def test_every_command_has_help_with_an_example(command: str) -> None:
    assert f"Example: list3r eval {command}" in read("eval", command, "--help")


def test_trajectory_tells_errors_and_coverage_and_draws(place: Path, tmp_path: Path) -> None:
    errors = ask("eval", "trajectory", place / "walk.txt", place / "walk.l3r", "--delta", "0.1s")
    assert errors["pairs"] == 52
    assert 0.005 < errors["ate_se3_m"]["rmse"] < 0.02
    assert errors["delta"] == {"value": 0.1, "unit": "s"}
    assert errors["covered"]["truth"] == 1.0
    text = read("eval", "trajectory", place / "walk.txt", place / "walk.l3r", "--plot", tmp_path / "a.png")
    assert "covers 100.0 % of the truth's time" in text
    assert Image.open(tmp_path / "a.png").size[0] > 500


def test_a_memory_in_two_parts_says_what_is_left_out(place: Path, tmp_path: Path) -> None:
    with Store.open(place / "parts.l3r") as store:
        poses = [(f.time_s, S.as_matrix()) for f, S in store.trajectory.poses()]
    write_tum(tmp_path / "truth.txt", Trajectory(np.array([t for t, _ in poses]), np.stack([T for _, T in poses])))
    result = run("eval", "trajectory", tmp_path / "truth.txt", place / "parts.l3r")
    assert result.returncode == 0, result.stderr
    assert re.search(r"31 of 52 frames.*1 other part", result.stderr)
    assert re.search(r"covers 5\d\.\d % .* longest stretch", result.stdout)


def test_cloud_of_a_memory_against_its_own_export_is_perfect(place: Path, tmp_path: Path) -> None:
    errors = ask("eval", "cloud", place / "room.ply", place / "room.l3r", "--plot", tmp_path / "a.svg")
    assert (errors["chamfer_cm"], errors["f_score"]) == (pytest.approx(0, abs=0.01), 1.0)
    assert "4 instances and 2 surfaces" in errors["estimate"]
    words = ("--align", str(place / "walk.txt"), "--path", str(place / "walk.txt"), "--voxel", "0")
    errors = ask("eval", "cloud", place / "room.ply", place / "room.ply", *words)
    assert errors["chamfer_cm"] < 1e-4
    assert "by the camera's path" in errors["alignment"]
    text = read("eval", "cloud", place / "room.l3r", place / "room.ply", "--align", "icp")
    assert re.search(r"Chamfer distance +0\.\d+ cm", text)
    assert "ICP" in text
    assert (tmp_path / "a.svg").stat().st_size > 1000


def test_cloud_against_the_depth_of_a_source(place: Path) -> None:
    errors = ask("eval", "cloud", place / "good", place / "room.ply", "--align", "none")
    assert "depth of 4 frames" in errors["truth"]
    assert errors["accuracy_cm"] > 0


def test_instances_with_ids_over_time_and_a_picture(place: Path, tmp_path: Path) -> None:
    folder = tmp_path / "truth"
    shutil.copytree(place / "truth", folder)
    (folder / "ids").mkdir()
    labels = np.zeros((48, 64), np.uint16)
    labels[20, 10:30] = 3
    for k in range(20):
        Image.fromarray(labels if k < 10 else np.where(labels == 3, 4, 0).astype(np.uint16)).save(
            folder / f"ids/{k:06d}.png"
        )
    words = ("eval", "instances", folder / "truth.json", place / "room.l3r")
    scores = ask(*words, "--plot", tmp_path / "a.pdf")
    assert scores["instances_0.50"]["recall"] == 1.0
    assert (scores["identities"]["frames"], scores["identities"]["objects"]) == (20, 2)
    assert scores["identities"]["switches"] == 0
    assert "0 id switches of 2 objects in 20 frames" in read(*words)
    assert (tmp_path / "a.pdf").read_bytes().startswith(b"%PDF")
    assert ask("eval", "instances", folder / "truth.json", place / "room.json")["identities"] is None


def test_revisits_of_stored_loops(place: Path, tmp_path: Path) -> None:
    words = ("eval", "revisits", place / "walk.npz", place / "walk.l3r")
    scores = ask(*words, "--plot", tmp_path / "a.png", "--save", tmp_path / "b.npz")
    assert scores["chunks"]["precision"] == 1.0
    assert scores["candidates"] == 2
    assert scores["rankings"]["s_sem"]["frame_recall"] == 1.0
    assert scores["rankings"]["s_det"]["frame_recall"] == 0.0
    again = ask("eval", "revisits", tmp_path / "b.npz", place / "walk.l3r")
    assert again == scores
    assert re.search(r"s_det .*\ns_rel .*\ns_sem ", read(*words))


def test_revisits_measured_on_the_frames_of_a_source(place: Path, tmp_path: Path) -> None:
    with Store.create(tmp_path / "tiny.l3r") as store, store.transaction():
        session = store.sessions.add("good", "abc", {}, 4)
        result = chunk_result(0, 0, 4, ())
        chunk = store.chunks.add(session, type(result)(**{**vars(result), "times_s": np.arange(4) * 0.1}))
        store.chunks.place({chunk: Sim3.identity()}, {chunk: chunk})
    scores = ask("eval", "revisits", place / "good", tmp_path / "tiny.l3r", "--save", tmp_path / "c.npz")
    assert scores["covisible_frames"] == 4
    with np.load(tmp_path / "c.npz") as arrays:
        assert arrays["share"].min() == 1.0
    assert "2 frames" in read("eval", "revisits", place / "good", tmp_path / "tiny.l3r", "--every", "2")


def test_poses_of_a_folder_are_read_without_its_pictures(place: Path) -> None:
    source = open_source(place / "good")
    assert isinstance(source, FolderSource)
    expected = [(f.index, f.time_s) for f in source.read(0, 4) if isinstance(f, Frame)]
    assert [(k, t) for k, t, _ in source.read_poses()] == expected
    assert all(np.array_equal(T, np.eye(4)) for _, _, T in source.read_poses())


# ---------------------------------------------------------------------------------------------- info, plan


def test_info_lists_every_loop_with_its_reason(place: Path) -> None:
    text = read("info", place / "walk.l3r", "--loops")
    assert "one part: all 5 chunks" in text
    assert re.search(r"4 pairs, 4 joined.*weakest 1-2 with weight 0\.60", text)
    assert "2 candidates, 1 accepted, 1 rejected" in text
    assert re.search(r"1-4 +2-33 +0\.07-1\.10 +0\.82 +0\.90 +0\.70 +900 +0\.012 +0\.400 +accepted", text)
    assert re.search(r"2-4 +12-35 +0\.40-1\.17 +0\.91 +0\.20 +- +0 +- +- +rejected +only 3 of 43", text)
    assert re.search(r"\n5 +0\.040 +2\.292 +4\.000", text)


def test_info_as_json_has_edges_components_and_uncertainty(place: Path) -> None:
    report = ask("info", place / "walk.l3r", "--loops")
    loops = [e for e in report["edges"] if e["kind"] == "loop"]
    assert [e["times_s"] for e in loops] == [[0.066667, 1.1], [0.4, 1.166667]]
    assert report["parts"][0]["chunks"] == [1, 2, 3, 4, 5]
    assert report["chunk_poses"][1]["sigma"]["position"] == pytest.approx(0.01)
    assert "edges" not in ask("info", place / "walk.l3r")


def test_info_says_which_parts_were_not_joined(place: Path) -> None:
    text = read("info", place / "parts.l3r", "--loops")
    assert "2 parts that could not be joined; positions of different parts must not be compared" in text
    assert re.search(r"part 1: chunks 1, 2, 3, frames 0-31\n +part 4: chunks 4, 5, frames 30-51", text)
    assert "0 candidates" in read("info", place / "room.l3r", "--loops")
    assert "no chunk is stored yet" in read("info", place / "empty.l3r", "--loops")


@pytest.mark.slow
def test_the_plan_draws_accepted_loops(place: Path, tmp_path: Path) -> None:
    violet = np.array([118, 84, 190])
    counts = []
    for name in ("walk", "room"):
        read("export", place / f"{name}.l3r", "--to", "plan", "--out", tmp_path / f"{name}.png")
        page = np.asarray(Image.open(tmp_path / f"{name}.png").convert("RGB")).astype(int)
        counts.append(int((np.abs(page - violet).sum(axis=2) < 30).sum()))
    assert counts[0] >= 20 > counts[1]
