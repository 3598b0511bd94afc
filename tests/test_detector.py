"""A box detector: its boxes, what they vote for, and what becomes of the labels."""

from __future__ import annotations

import hashlib
import json
import math
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from list3r.cli.app import run
from list3r.memory.core.description.coco import COCO_80, SIZES_M, plausible
from list3r.memory.core.errors import OptionError
from list3r.memory.core.records import Votes
from list3r.memory.library.consolidation import consolidate
from list3r.memory.library.labels import (
    OWN_NAMES,
    LabelSettings,
    apply_labels,
    decide,
    put_votes,
    votes_of_names,
    votes_of_probabilities,
)
from list3r.memory.library.maintenance import edits
from list3r.memory.store.store import Store
from list3r.queries.find import find
from list3r.semantics.detection import detect
from list3r.semantics.detector import Detections
from list3r.semantics.nanodet import PUBLISHED, DetectorSettings, NanoDet, overlaps, read_class_names, suppressed
from list3r.semantics.voting import ThingInFrame, summed, vote
from list3r.weights import PublishedFile, fetch_files
from tests.session_scenes import ROOM, add_session, cameras, place_together

SHARED = Path(__file__).resolve().parents[2] / "shared"
WEIGHTS = SHARED / "weights" / "nanodet"
KITCHEN = SHARED / "data" / "redkitchen"
needs_weights = pytest.mark.skipif(not WEIGHTS.is_dir(), reason=f"the detector's weights are not at {WEIGHTS}")


def box(*values: float) -> np.ndarray:
    return np.array(values, np.float32)


def found(*rows: tuple[tuple[float, ...], float, int]) -> Detections:
    return Detections(
        np.array([r[0] for r in rows], np.float32).reshape(-1, 4),
        np.array([r[1] for r in rows], np.float32),
        np.array([r[2] for r in rows], np.int64),
    )


def seen(local_id: int, x0: int, y0: int, x1: int, y1: int, **more: object) -> ThingInFrame:
    mask = np.zeros((480, 640), bool)
    mask[y0:y1, x0:x1] = True
    fields: dict[str, object] = {"locals": (local_id,), "shares": (1.0,), "visible": 1.0, **more}
    return ThingInFrame(box_xyxy=box(x0, y0, x1, y1), mask=mask, **fields)  # type: ignore[arg-type]


# ---------------------------------------------------------------------------------------------- boxes


@given(st.lists(st.tuples(st.integers(0, 40), st.integers(0, 40), st.integers(1, 30), st.integers(1, 30)), max_size=12))
def test_what_stays_does_not_overlap_and_what_goes_overlaps_something_surer(rows: list[tuple[int, ...]]) -> None:
    boxes = np.array([(x, y, x + w, y + h) for x, y, w, h in rows], np.float32).reshape(-1, 4)
    scores = np.linspace(0.9, 0.3, len(rows)).astype(np.float32)[::-1].copy()
    classes = np.arange(len(rows)) % 2
    kept = suppressed(boxes, scores, classes, 0.5).tolist()
    assert scores[kept].tolist() == sorted(scores[kept].tolist(), reverse=True)
    for k in range(len(rows)):
        same = [j for j in kept if classes[j] == classes[k] and j != k]
        near = [j for j in same if overlaps(boxes[k], boxes[[j]])[0] > 0.5]
        assert (k in kept and not near) or (k not in kept and any(scores[j] >= scores[k] for j in near))


def test_overlaps_of_known_boxes() -> None:
    others = np.array([[0, 0, 10, 10], [5, 0, 15, 10], [20, 20, 30, 30], [0, 0, 0, 0]], np.float32)
    np.testing.assert_allclose(overlaps(box(0, 0, 10, 10), others), [1.0, 1 / 3, 0.0, 0.0], atol=1e-6)


@needs_weights
@pytest.mark.data
@pytest.mark.parametrize("name", ["nanodet-m", "nanodet-m-416"])
def test_a_real_network_finds_cups_chairs_and_the_table(name: str) -> None:
    pytest.importorskip("ncnn")
    picture = cv2.imread(str(KITCHEN / "frame-000600.color.jpg"))
    if picture is None:
        pytest.skip("redkitchen is absent")
    network = NanoDet(WEIGHTS / f"{name}.param", settings=DetectorSettings(min_score=0.3))
    color = np.ascontiguousarray(picture[..., ::-1])
    boxes = network(color)
    names = {network.class_names[c] for c in boxes.classes}
    assert {"cup", "dining table", "book"} <= names
    assert (boxes.scores >= 0.3).all() and (boxes.boxes_xyxy >= 0).all() and (boxes.boxes_xyxy[:, 2] <= 640).all()
    cup = boxes.boxes_xyxy[boxes.classes == COCO_80.index("cup")]
    assert all(10 < w < 120 and 10 < h < 120 for w, h in (cup[:, 2:] - cup[:, :2]))
    for _ in range(3):
        again = network(color)
        np.testing.assert_array_equal(again.boxes_xyxy, boxes.boxes_xyxy)
    # Half as large, the same things are found at half the place.
    half = network(cv2.resize(color, (320, 240), interpolation=cv2.INTER_AREA))
    table = [b.boxes_xyxy[b.classes == COCO_80.index("dining table")][0] for b in (boxes, half)]
    assert overlaps(table[0], 2 * table[1][None])[0] > 0.7
    odd = network(color[:333, :517])
    assert (odd.boxes_xyxy[:, 2] <= 517).all() and (odd.boxes_xyxy[:, 3] <= 333).all()


@needs_weights
def test_detectors_that_cannot_be_used(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("ncnn")
    source = WEIGHTS / "nanodet-m.param"
    lone = Path(shutil.copy(source, tmp_path / "lone.param"))
    (tmp_path / "text.param").write_text("hello")
    (tmp_path / "names.txt").write_text("cup\nchair\n")
    (tmp_path / "none.txt").write_text("\n")
    assert read_class_names(tmp_path / "names.txt") == ("cup", "chair")
    for use in (
        lambda: NanoDet(lone),
        lambda: NanoDet(tmp_path / "text.param"),
        lambda: NanoDet(tmp_path / "absent.param"),
        lambda: NanoDet(source, ("cup", "chair")),
        lambda: read_class_names(tmp_path / "none.txt"),
        lambda: read_class_names(tmp_path / "absent.txt"),
    ):
        with pytest.raises(OptionError, match="--detector"):
            use()
    cut = Path(shutil.copy(source, tmp_path / "cut.param"))
    (tmp_path / "cut.bin").write_bytes(source.with_suffix(".bin").read_bytes()[:1000])
    with pytest.raises(OptionError, match="complete"):
        NanoDet(cut)
    (tmp_path / "walk").mkdir()
    words = ["build", str(tmp_path / "walk"), "-m", str(tmp_path / "m.l3r"), "--detector", str(lone)]
    assert run(words) == 2 and not (tmp_path / "m.l3r").exists()
    assert ".bin" in capsys.readouterr().err


def test_sizes_are_of_classes_and_make_sense() -> None:
    assert set(SIZES_M) == set(COCO_80) and len(set(COCO_80)) == 80
    assert all(0 < low < high for low, high in SIZES_M.values())
    assert plausible("cup", np.array([0.1, 0.1, 0.12])) and not plausible("cup", np.array([0.1, 0.1, 1.2]))
    assert plausible("dining table", np.array([2.0, 0.9, 0.4])) and plausible("my own class", np.array([9.0, 9, 9]))
    assert not plausible("dining table", np.array([1.9, 0.07, 0.9]))


# ---------------------------------------------------------------------------------------------- votes


def test_a_box_speaks_of_the_thing_that_fills_it() -> None:
    table, mug = seen(0, 100, 200, 600, 460), seen(1, 300, 220, 340, 270)
    frame = found(((95, 195, 605, 465), 0.6, 60), ((298, 218, 343, 272), 0.5, 41))
    votes = vote(frame, COCO_80, [table, mug])
    assert set(votes[0].classes) == {"dining table"} and set(votes[1].classes) == {"cup"}
    assert votes[0].classes["dining table"][1] > votes[0].missed > 0
    elsewhere = vote(found(((10, 10, 60, 60), 0.9, 41)), COCO_80, [table, mug])
    assert not elsewhere[0].classes and not elsewhere[1].classes and elsewhere[1].missed > 0


def test_what_is_hidden_tiny_or_of_another_size_is_not_spoken_of() -> None:
    frame = found(((298, 218, 343, 272), 0.5, 41))
    mug = (300, 220, 340, 270)
    assert vote(frame, COCO_80, [seen(1, *mug, visible=0.2)]) == {}
    assert vote(found(((300, 220, 308, 230), 0.9, 41)), COCO_80, [seen(1, 300, 220, 308, 230)]) == {}
    big = vote(frame, COCO_80, [seen(1, *mug, size_m=np.array([0.5, 0.4, 0.3]))])
    assert not big[1].classes and big[1].missed > 0
    right = vote(frame, COCO_80, [seen(1, *mug, size_m=np.array([0.1, 0.08, 0.11]))])
    assert right[1].classes
    soon = vote(frame, COCO_80, [seen(1, *mug)], 0.1)[1]
    assert soon.classes["cup"][1] == pytest.approx(0.25 * vote(frame, COCO_80, [seen(1, *mug)])[1].classes["cup"][1])


def test_pieces_share_the_vote_of_their_thing() -> None:
    frame = found(((298, 218, 343, 272), 0.5, 41))
    whole = vote(frame, COCO_80, [seen(1, 300, 220, 340, 270)])[1]
    pieces = vote(frame, COCO_80, [seen(1, 300, 220, 340, 270, locals=(1, 2), shares=(0.75, 0.25))])
    together = pieces[1] + pieces[2]
    assert together.missed == pytest.approx(whole.missed)
    assert together.classes["cup"] == pytest.approx(whole.classes["cup"])


counts = st.integers(0, 12)


@given(cups=counts, bowls=counts, misses=st.integers(0, 200))
def test_labels_follow_the_votes(cups: int, bowls: int, misses: int) -> None:
    mug = seen(1, 300, 220, 340, 270)
    frames = [vote(found(((300, 220, 340, 270), 0.45, c)), COCO_80, [mug]) for c in [41] * cups + [45] * bowls]
    frames += [vote(found(), COCO_80, [mug]) for _ in range(misses)]
    total = summed(frames).get(1, Votes(0.0, {}))
    backwards = summed(frames[::-1]).get(1, Votes(0.0, {}))
    label = decide({"net": total})
    assert (label and label[0]) == ((other := decide({"net": backwards})) and other[0])
    if label is not None:
        assert label[0] == ("cup" if cups > bowls else "bowl") and 0.5 <= label[1] <= 0.97
    if cups >= 2 and bowls == 0 and 4 * misses <= cups:
        assert label is not None
    if cups + bowls <= 1 or misses > 2 * max(cups, bowls):
        assert label is None


EVERY = LabelSettings(min_confidence=0.0, always_wrong=0.0)


def test_many_alike_pictures_say_no_more_than_a_few_different_ones() -> None:
    mug = seen(1, 300, 220, 340, 270)

    def odds(looks: int, score: float, missed: int = 0) -> float:
        """Log odds of a cup after so many looks that found one, and others that found nothing."""
        frames = [vote(found(((300, 220, 340, 270), score, 41)), COCO_80, [mug])] * looks
        label = decide({"net": summed([*frames, *[vote(found(), COCO_80, [mug])] * missed])[1]}, settings=EVERY)
        assert label is not None
        return math.log(label[1] / (1.0 - label[1]))

    assert odds(8, 0.2) - odds(2, 0.2) > 1.0 and abs(odds(800, 0.2) - odds(100, 0.2)) < 0.2
    assert odds(8, 0.1) < odds(8, 0.2) < odds(8, 0.4)
    assert odds(100, 0.12, missed=100) < 0.0  # what looks a little like a cup in every other picture is not one


def test_a_box_that_goes_on_where_no_mask_can_be_fits_what_is_seen_of_it() -> None:
    chair = seen(1, 500, 200, 590, 440)
    frame = found(((500, 200, 639, 470), 0.5, 56))
    region = box(10, 10, 590, 456)
    whole, cut = (vote(frame, COCO_80, [chair], region_xyxy=r)[1].classes for r in (None, region))
    assert cut["chair"][1] > whole["chair"][1]


# ---------------------------------------------------------------------------------------------- labels


@pytest.fixture
def memory(tmp_path: Path) -> Path:
    """A room of boxes seen in two sessions, one chunk each."""
    path = tmp_path / "m.l3r"
    with Store.create(path) as store, store.transaction():
        store.facts.scale_kind = "metric"
        for start in (0.4, 1.0):
            add_session(store, ROOM, cameras((0.0, 0.0, 0.75), start))
            place_together(store)
            consolidate(store)
    return path


CUP = Votes(0.5, {"cup": (4.0, 16.0)})
CHAIR = Votes(0.5, {"chair": (4.0, 14.0)})


def named(store: Store, rgb: tuple[int, int, int]) -> int:
    return min(store.instances.all(), key=lambda i: float(np.abs(np.subtract(i.color_rgb, rgb)).sum())).id


def say(
    store: Store,
    instance_id: int,
    votes: Votes,
    chunk: int | None = None,
    source: str = "test-net",
    classes: tuple[str, ...] | None = None,
) -> None:
    """A detector saw an instance so, in one chunk or in all."""
    with store.transaction():
        for c in store.chunks.all():
            kept = store.votes.of(c.chunk_id).get(source, {})
            for o in store.observations.of(instance_id):
                if o.chunk_id == c.chunk_id and chunk in (None, c.chunk_id):
                    kept[o.local_id] = votes
            put_votes(store, c.chunk_id, source, kept, classes)
        apply_labels(store)


def test_votes_are_kept_and_name_things(memory: Path) -> None:
    with Store.open(memory, writable=True) as store:
        red, blue = named(store, ROOM["red"].rgb), named(store, ROOM["blue"].rgb)
        say(store, red, CUP)
        assert store.instances.get(red).label == "cup" and store.instances.get(blue).label is None
        told = store.detected_labels.all()[red]
        assert told.detector == "test-net" and 0.9 < told.confidence <= 0.97
        assert store.votes.of(1) == {
            "test-net": {o.local_id: CUP for o in store.observations.of(red) if o.chunk_id == 1}
        }
        assert not store.verify()


def test_a_source_that_looks_again_replaces_its_own_votes_only(memory: Path) -> None:
    with Store.open(memory, writable=True) as store:
        red = named(store, ROOM["red"].rgb)
        say(store, red, votes_of_names([("mug", 0.9)] * 6), source="segmenter")
        assert store.instances.get(red).label == "mug"
        say(store, red, Votes(0.5, {"cup": (9.0, 40.0)}), source="one")
        assert store.detected_labels.all()[red].label == "cup" and store.detected_labels.all()[red].detector == "one"
        say(store, red, Votes(1.0, {}), source="one")
        assert (
            store.detected_labels.all()[red].label == "mug" and store.detected_labels.all()[red].detector == "segmenter"
        )
        assert set(store.votes.of(1)) == {"segmenter", "one"}


def test_what_two_detectors_see_adds_up(memory: Path) -> None:
    weak = Votes(0.2, {"cup": (0.4, 2.4)})
    with Store.open(memory, writable=True) as store:
        red = named(store, ROOM["red"].rgb)
        say(store, red, weak, source="one")
        assert store.instances.get(red).label is None
        say(store, red, weak, source="two")
        assert (
            store.detected_labels.all()[red].label == "cup" and store.detected_labels.all()[red].detector == "one, two"
        )


def test_a_detector_says_nothing_against_what_it_does_not_know(memory: Path) -> None:
    with Store.open(memory, writable=True) as store:
        red = named(store, ROOM["red"].rgb)
        say(store, red, votes_of_names([("flower pot", 0.9)] * 6), source="segmenter")
        say(store, red, Votes(30.0, {}), source="one", classes=("cup", "bowl"))
        assert store.instances.get(red).label == "flower pot"
        say(store, red, Votes(30.0, {}), source="one", classes=("cup", "flower pot"))
        assert store.instances.get(red).label is None


def test_an_operator_has_the_last_word(memory: Path) -> None:
    with Store.open(memory, writable=True) as store:
        red, blue = named(store, ROOM["red"].rgb), named(store, ROOM["blue"].rgb)
        edits.label(store, red, "ann's mug", "ann")
        say(store, red, CUP)
        say(store, blue, CUP)
        assert store.instances.get(red).label == "ann's mug" and red not in store.detected_labels.all()
        edits.label(store, blue, None, "ann")
        with store.transaction():
            consolidate(store)
            apply_labels(store)
        assert store.instances.get(blue).label is None
        edits.undo(store)
        assert store.instances.get(blue).label == "cup"


def test_labels_follow_merges_splits_and_undo(memory: Path) -> None:
    with Store.open(memory, writable=True) as store:
        red, blue = named(store, ROOM["red"].rgb), named(store, ROOM["blue"].rgb)
        say(store, red, CUP)
        edits.merge(store, red, blue, "ann")
        assert store.instances.get(store.ids.resolve(red)).label == "cup"
        edits.undo(store)
        assert store.instances.get(red).label == "cup" and store.instances.get(blue).label is None
        green = named(store, ROOM["green"].rgb)
        say(store, green, CHAIR, chunk=2)
        assert store.instances.get(green).label == "chair"
        report = edits.split(store, green, [(o.chunk_id, o.local_id) for o in store.observations.of(green)][1:], "ann")
        labels = {n: store.instances.get(n).label for n in report.ids}
        assert set(labels.values()) == {None, "chair"}


def test_labels_survive_deriving_the_library_anew_and_go_with_their_votes(memory: Path) -> None:
    with Store.open(memory, writable=True) as store:
        red = named(store, ROOM["red"].rgb)
        say(store, red, CUP)
        with store.transaction():
            consolidate(store)
            assert apply_labels(store).keys() == {red}
        assert store.instances.get(red).label == "cup"
        say(store, red, Votes(3.0, {}))
        assert store.instances.get(red).label is None and not store.detected_labels.all()


def test_structure_is_never_named(make_memory: Callable[..., Path]) -> None:
    with Store.open(make_memory(), writable=True) as store, store.transaction():
        put_votes(store, 1, "test-net", dict.fromkeys(range(6), CHAIR))
        apply_labels(store)
        for i in store.instances.all():
            assert i.label == (None if i.structure else "chair")


def test_where_a_label_comes_from_is_told(memory: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    with Store.open(memory, writable=True) as store:
        red, blue = named(store, ROOM["red"].rgb), named(store, ROOM["blue"].rgb)
        say(store, red, CUP)
        edits.label(store, blue, "vase", "ann")
    assert run(["show", str(memory), str(red)]) == 0 and "test-net" in capsys.readouterr().out
    assert run(["show", str(memory), str(blue), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["matches"][0]["label_source"] == "operator"
    assert run(["export", str(memory), "--to", "json", "--out", str(tmp_path / "s.json")]) == 0
    rows = {i["id"]: i for i in json.loads((tmp_path / "s.json").read_text())["instances"]}
    assert (rows[red]["label_source"], rows[blue]["label_confidence"]) == ("test-net", 1.0)
    assert "label_source" not in rows[named_in(rows)]


def test_what_is_only_known_to_be_a_seat_is_told_so_and_found_after_the_chairs(
    memory: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with Store.open(memory, writable=True) as store:
        red, green = named(store, ROOM["red"].rgb), named(store, ROOM["green"].rgb)
        say(store, red, votes_of_probabilities([("chair", 0.5), ("stool", 0.3), ("sofa", 0.19)]), source=OWN_NAMES)
        say(store, green, CHAIR)
        assert store.detected_labels.all()[red].level == "branch" and store.instances.get(red).label == "seat"
        assert find(store, "seat")[0].instance.id == red
        assert find(store, "how many chairs are there?").counted == 1
    assert run(["find", str(memory), "chair", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["matches"]
    assert [r["id"] for r in rows] == [green, red] and rows[1]["score"] < 0.5 < rows[0]["score"]
    assert "may be a chair" in rows[1]["reason"]
    assert run(["show", str(memory), str(red), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["matches"][0]["label_level"] == "branch"


def named_in(rows: dict[int, dict[str, object]]) -> int:
    """An instance without a label."""
    return next(n for n, row in rows.items() if row["label"] is None)


class Everything:
    """A detector that calls the whole picture one thing."""

    name = "everything"
    class_names = ("thing",)

    def __call__(self, color: np.ndarray) -> Detections:
        return found(((0, 0, color.shape[1], color.shape[0]), 0.9, 0))


def test_a_memory_without_pictures_says_what_is_needed(memory: Path) -> None:
    with Store.open(memory, writable=True) as store:
        with pytest.raises(OptionError, match="--source"):
            detect(store, Everything())
        assert store.votes.of(1) == {}


# ---------------------------------------------------------------------------------------------- weights


def test_weights_are_fetched_once_told_before_and_refused_where_they_are_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    origin, told = tmp_path / "origin.bin", list[str]()
    origin.write_bytes(b"weights")
    file = PublishedFile(origin.as_uri(), hashlib.sha256(b"weights").hexdigest(), 7)
    folder = fetch_files("net", {"net.bin": file}, told.append)
    assert (folder / "net.bin").read_bytes() == b"weights" and "0.0 MB" in told[0]
    origin.unlink()
    assert fetch_files("net", {"net.bin": file}, told.append) == folder and len(told) == 1
    with pytest.raises(OptionError, match="cannot be fetched"):
        fetch_files("net", {"other.bin": file}, told.append)
    origin.write_bytes(b"changed")
    with pytest.raises(OptionError, match="not the file that was published"):
        fetch_files("net", {"other.bin": file}, told.append)
    assert sorted(p.name for p in folder.iterdir()) == ["net.bin"]


@needs_weights
def test_the_weights_that_are_fetched_are_those_that_are_measured() -> None:
    for name, file in PUBLISHED.items():
        data = (WEIGHTS / name).read_bytes()
        assert (hashlib.sha256(data).hexdigest(), len(data)) == (file.sha256, file.size_bytes)


def test_our_nouns_are_the_prompts_of_an_open_vocabulary(tmp_path: Path) -> None:
    t = pytest.importorskip("transformers")
    torch = pytest.importorskip("torch")
    from list3r.semantics.open_vocabulary import OpenVocabulary
    from tests.neural_models import save_text_image

    folder = save_text_image("clip", tmp_path)
    (folder / "model.safetensors").unlink()
    small = {"hidden_size": 16, "intermediate_size": 16, "num_hidden_layers": 1, "num_attention_heads": 2}
    text = small | {"vocab_size": 12, "max_position_embeddings": 16, "eos_token_id": 2, "pad_token_id": 0}
    vision = small | {"image_size": 32, "patch_size": 8}
    torch.manual_seed(0)
    config = t.Owlv2Config(text_config=text, vision_config=vision, projection_dim=16)
    t.Owlv2ForObjectDetection(config).save_pretrained(folder)
    network = OpenVocabulary(folder, "cpu")
    assert {"chair", "mug"} <= set(network.class_names) and len(network.class_names) > 300
    picture = np.random.default_rng(0).integers(0, 255, (60, 80, 3), np.uint8)
    seen = network(picture)
    assert len(seen.scores) == len(seen.classes) > 0
    assert (seen.boxes_xyxy >= 0).all() and (seen.boxes_xyxy <= [80, 60, 80, 60]).all()
    again = network(picture)
    assert np.array_equal(seen.boxes_xyxy, again.boxes_xyxy)
