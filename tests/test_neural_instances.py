"""Neural discovery, tracking and features: real architectures with small random weights, and rules on known masks."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

pytest.importorskip("transformers")

from list3r.instances.base import Proposals
from list3r.instances.geometric.views import chunk_views
from list3r.instances.learned.discovery import LearnedDiscoverer
from list3r.instances.library import build_library
from list3r.instances.neural.appearance import Appearance, WithAppearance, label_shares
from list3r.instances.neural.candidates import SoftMasks, bounds_the_room, choose_candidates
from list3r.instances.neural.query_segmenter import QuerySegmenter
from list3r.instances.neural.sam_masks import SamMasks
from list3r.instances.registry import check_choice, make_discoverer, make_frame_descriptor, make_tracker
from list3r.instances.settings import CandidateSettings, InstanceSettings, SamMaskSettings, VideoTrackerSettings
from list3r.instances.tracking.video_tracker import VideoTracker, _Objects
from list3r.memory.core.errors import OptionError
from list3r.memory.core.records import LocalLibrary
from list3r.models import pretrained
from list3r.models.images import InputShape, network_input, to_picture
from list3r.reconstruction.keyframe_record import KeyframeNetworks, make_keyframes
from tests import neural_models
from tests.test_instances_library import SCENE, walk

EVERYTHING = CandidateSettings(min_score=0.0, min_area_share=1e-4)
SAM_ALL = SamMaskSettings(points_per_side=4, min_quality=0.0, min_stability=0.0, candidates=EVERYTHING)


@pytest.fixture(scope="module")
def checkpoints(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    base = tmp_path_factory.mktemp("weights")
    return {name: neural_models.save(name, base / name.replace("/", "-")) for name in neural_models._MAKERS}


@pytest.fixture(scope="module")
def chunk():
    return walk(SCENE, 10)


@pytest.mark.parametrize("model", ["eomt", "mask2former"])
def test_segmenter_proposes_disjoint_named_masks(model: str, checkpoints: dict[str, Path], chunk) -> None:
    frames, reconstruction = chunk
    segmenter = QuerySegmenter(model, checkpoints[f"discovery/{model}"], "cpu", InstanceSettings(candidates=EVERYTHING))
    found = segmenter(frames, reconstruction, 5)
    assert found.labels.shape == frames[5].color.shape[:2]
    assert found.labels.max() == len(found.score) > 0
    assert found.features.shape == (len(found.score), 32)
    np.testing.assert_allclose(np.linalg.norm(found.features, axis=1), 1.0, rtol=1e-5)
    assert (np.diff(found.score) <= 0).all()
    assert set(found.names) <= set(neural_models.NAMES.values())
    assert segmenter.feature_space.startswith(f"{model}@") and segmenter.feature_space.endswith("/32")


@pytest.mark.parametrize("model", ["sam2", "sam3"])
def test_point_grid_finds_masks(model: str, checkpoints: dict[str, Path], chunk) -> None:
    frames, _ = chunk
    discoverer = SamMasks(model, checkpoints[f"discovery/{model}"], "cpu", InstanceSettings(sam=SAM_ALL))
    masks = discoverer.segment(frames[3].color)
    assert masks.probability.shape[1:] == frames[3].color.shape[:2]
    assert len(masks.score) == len(masks.features) == len(masks.probability)
    assert (np.diff(masks.score) <= 0).all()


@pytest.mark.slow
@pytest.mark.parametrize("model", ["sam2", "sam3", "edgetam"])
def test_tracker_follows_prompts_through_the_chunk(model: str, checkpoints: dict[str, Path]) -> None:
    frames, reconstruction = walk(SCENE, 6)
    settings = InstanceSettings(anchor_step=3)
    tracker = VideoTracker(model, checkpoints[f"tracking/{model}"], "cpu", settings)
    library = build_library(frames, reconstruction, settings, LearnedDiscoverer(settings), tracker)
    assert isinstance(library, LocalLibrary)
    assert library.feature_space == settings.feature_space
    again = build_library(frames, reconstruction, settings, LearnedDiscoverer(settings), tracker)
    assert [len(i.track.frames) for i in library.instances] == [len(i.track.frames) for i in again.instances]


@pytest.fixture
def half_precision(monkeypatch: pytest.MonkeyPatch) -> None:
    """As on a GPU."""
    monkeypatch.setattr(pretrained, "network_dtype", lambda device: torch.bfloat16)


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(neural_models._MAKERS))
def test_every_network_runs_in_half_precision(
    name: str, half_precision: None, checkpoints: dict[str, Path], chunk
) -> None:
    part, model = name.split("/")
    frames, reconstruction = chunk
    color = frames[3].color
    if part == "features":
        made = list(Appearance(model, checkpoints[name], "cpu").tokens(color))
    elif part == "discovery":
        maker = SamMasks if model.startswith("sam") else QuerySegmenter
        found = maker(model, checkpoints[name], "cpu", InstanceSettings(candidates=EVERYTHING, sam=SAM_ALL)).segment(
            color
        )
        assert len(found.score) > 0
        made = [found.probability, found.score, found.features]
    else:
        tracker = VideoTracker(model, checkpoints[name], "cpu", InstanceSettings(anchor_step=5))
        proposals = [LearnedDiscoverer(tracker._settings)(frames, reconstruction, p) for p in (0, 5)]
        things = _Objects(proposals, chunk_views(frames, reconstruction, tracker._settings), tracker._tracker)
        swept = tracker._sweep(frames, range(2), things, forwards=True)  # a CPU takes long over bfloat16
        made = [logits for _, masks in swept for logits in masks.values()]
        assert len(made) >= 2
    assert all(np.isfinite(array).all() for array in made)


@pytest.mark.parametrize("model", ["eomt", "mask2former", "sam2"])
def test_a_picture_without_things_has_none(model: str, checkpoints: dict[str, Path], chunk) -> None:
    nothing = CandidateSettings(min_score=1.1)
    if model == "sam2":
        network = SamMasks(
            model, checkpoints["discovery/sam2"], "cpu", InstanceSettings(sam=SamMaskSettings(4, min_quality=1.1))
        )
    else:
        network = QuerySegmenter(model, checkpoints[f"discovery/{model}"], "cpu", InstanceSettings(candidates=nothing))
    frames, reconstruction = chunk
    found = network(frames, reconstruction, 0)
    assert len(found.score) == 0 and found.labels.max() == 0


def test_the_tracker_state_stays_small(checkpoints: dict[str, Path], chunk) -> None:
    frames, reconstruction = chunk
    long = [replace(frames[k % len(frames)], index=k) for k in range(40)]
    tracker = VideoTracker("sam2", checkpoints["tracking/sam2"], "cpu")
    things = _things(reconstruction, [0], np.ones((240, 320), np.int32))
    kept = []
    sessions = []
    make = tracker._new_session
    tracker._new_session = lambda frames: sessions.append(make(frames)) or sessions[-1]
    for _ in tracker._sweep(long, range(40), things, forwards=True):
        (session,) = sessions
        kept.append(len(session.output_dict_per_obj[0]["non_cond_frame_outputs"]))
        assert all(frame is None for frame in session.processed_frames.values())
    assert max(kept) <= 18


def test_live_things_are_capped(checkpoints: dict[str, Path], chunk) -> None:
    frames, reconstruction = chunk
    labels = np.arange(240 * 320).reshape(240, 320) // (48 * 320) + 1
    tracker = VideoTracker(
        "sam2", checkpoints["tracking/sam2"], "cpu", InstanceSettings(video_tracker=VideoTrackerSettings(most_live=3))
    )
    things = _things(reconstruction, [0, 6], labels.astype(np.int32), most_live=3)
    seen = [len(masks) for _, masks in tracker._sweep(frames, range(10), things, forwards=True)]
    assert things.count >= 5
    assert max(seen) == 3


@pytest.mark.parametrize("model", ["dinov2", "dinov3"])
def test_features_are_pooled_inside_masks(model: str, checkpoints: dict[str, Path], chunk) -> None:
    frames, reconstruction = chunk
    appearance = Appearance(model, checkpoints[f"features/{model}"], "cpu", long_side=112)
    found = WithAppearance(LearnedDiscoverer(), appearance)(frames, reconstruction, 5)
    assert found.features.shape == (len(found.score), 32)
    np.testing.assert_allclose(np.linalg.norm(found.features, axis=1), 1.0, rtol=1e-5)
    whole = np.ones(frames[0].color.shape[:2], np.int32)
    _, patches = appearance.tokens(frames[0].color)
    mean = patches.reshape(-1, 32).mean(axis=0)
    # The grid of 8 x 6 cells divides this picture evenly, so that all cells weigh the same.
    got = appearance.pooled(frames[0].color, whole, 1)[0]
    assert got @ mean / np.linalg.norm(mean) > 0.999


@pytest.mark.parametrize("model", ["dinov2", "dinov3"])
def test_a_frame_is_described_by_its_class_token_and_its_pooled_tokens(
    model: str, checkpoints: dict[str, Path], chunk
) -> None:
    frames, reconstruction = chunk
    folders = ((f"features/{model}", str(checkpoints[f"features/{model}"])),)
    look = make_frame_descriptor(model, folders, "cpu")
    assert look is not None and make_frame_descriptor("geometric", (), "cpu") is None
    found = look(frames[0].color)
    token, patches = Appearance(model, checkpoints[f"features/{model}"], "cpu").tokens(frames[0].color)
    flat = patches.reshape(-1, 32).astype(float)
    pooled = np.cbrt((flat**3).mean(axis=0))
    for part, whole in ((found[:32], token), (found[32:], pooled)):
        np.testing.assert_allclose(part, whole / np.linalg.norm(whole) / np.sqrt(2), atol=1e-5)
    by = KeyframeNetworks(frame_descriptor=look)
    few = replace(reconstruction, keyframes=np.array([0, 5]))
    kept = make_keyframes(frames, few, False, networks=by)
    np.testing.assert_allclose(kept[0].descriptor, found, atol=1e-6)
    assert len(kept[0].keypoints_xy) > 0, "local features stay, for verification"


def test_shares_count_every_pixel_once() -> None:
    labels = np.random.default_rng(0).integers(0, 5, (31, 47)).astype(np.int32)
    shares = label_shares(labels, 4, (5, 7))
    np.testing.assert_array_equal(shares.sum(axis=1), [(labels == k).sum() for k in range(1, 5)])


def test_registry_makes_what_is_named(checkpoints: dict[str, Path]) -> None:
    folders = tuple((name, str(folder)) for name, folder in checkpoints.items())
    settings = InstanceSettings()
    found = make_discoverer("learned", "dinov2", folders, "cpu", settings)
    assert found.feature_space.startswith("dinov2@")
    assert isinstance(make_tracker("edgetam", folders, "cpu", settings), VideoTracker)
    for wrong in (("eomt", "reprojection", "geometric"), ("magic", "reprojection", "own"), ("eomt", "magic", "own")):
        with pytest.raises(OptionError):
            check_choice(*wrong)


def test_published_weights_of_sam_serve_masks_and_tracking(tmp_path: Path) -> None:
    for model in ("sam2", "sam3"):
        folder = neural_models.save("sam3" if model == "sam3" else "tracking/sam2", tmp_path / model)
        masks, tracker = SamMasks(model, folder, "cpu"), VideoTracker(model, folder, "cpu")
        one, other = (n._network.mask_decoder.conv_s0.weight for n in (masks, tracker))
        assert torch.equal(one, other), "both are read from one checkpoint"


def test_weights_of_another_network_are_refused(checkpoints: dict[str, Path], tmp_path: Path) -> None:
    with pytest.raises(OptionError, match=r"other weights|cannot be loaded"):
        Appearance("dinov2", checkpoints["features/dinov3"], "cpu")
    with pytest.raises(OptionError, match=r"no config\.json"):
        Appearance("dinov2", tmp_path, "cpu")
    with pytest.raises(OptionError, match="does not exist"):
        Appearance("dinov2", tmp_path / "none", "cpu")


def test_cut_off_weights_are_refused(checkpoints: dict[str, Path], tmp_path: Path) -> None:
    source = checkpoints["features/dinov2"]
    (tmp_path / "config.json").write_bytes((source / "config.json").read_bytes())
    whole = (source / "model.safetensors").read_bytes()
    (tmp_path / "model.safetensors").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(OptionError, match="cut off"):
        Appearance("dinov2", tmp_path, "cpu")


def test_a_gpu_that_is_not_there_is_named(checkpoints: dict[str, Path]) -> None:
    for device in ("cuda:99", "toaster"):
        with pytest.raises(OptionError, match="--device"):
            Appearance("dinov2", checkpoints["features/dinov2"], device)


def test_a_picture_survives_the_way_to_the_network_and_back() -> None:
    import torch

    color = np.zeros((48, 80, 3), np.uint8)
    color[10:20, 30:60] = 255
    shape = InputShape(96, 96, keep_aspect=True, mean=(0, 0, 0), std=(1, 1, 1))
    batch = network_input(color, shape, torch.device("cpu"), torch.float32)
    assert batch.shape == (1, 3, 96, 96)
    assert float(batch[..., 58:, :].abs().max()) == 0.0
    back = to_picture(batch[0], shape, 48, 80)[0].numpy()
    assert np.abs(back - color[..., 0] / 255.0).mean() < 0.02


def test_a_picture_is_filled_up_as_its_network_was_trained() -> None:
    color = np.full((30, 40, 3), 255, np.uint8)
    for black in (False, True):
        shape = InputShape(40, 40, keep_aspect=True, black=black)
        picture = network_input(color, shape, torch.device("cpu"), torch.float32)[0]
        below = picture[:, 35:].mean(dim=(1, 2)) * torch.tensor(shape.std) + torch.tensor(shape.mean)
        torch.testing.assert_close(below, torch.zeros(3) if black else torch.tensor(shape.mean))


def test_better_masks_take_the_pixels_and_redundant_ones_go(chunk) -> None:
    frames, reconstruction = chunk
    views = chunk_views(frames, reconstruction, InstanceSettings())
    probability = np.zeros((4, 240, 320), np.float32)
    probability[0, 50:100, 50:100] = 0.9
    probability[1, 52:100, 50:100] = 0.8
    probability[2, 90:200, 90:200] = 0.9
    probability[3, 0:2, 0:2] = 0.9
    masks = SoftMasks(probability, np.array([0.9, 0.9, 0.8, 0.9], np.float32), np.eye(4, dtype=np.float32))
    found = choose_candidates(masks, views, 5)
    assert len(found.score) == 2
    assert found.labels[95, 95] == 1 and found.labels[150, 150] == 2 and found.labels[1, 1] == 0


def test_flat_masks_carry_their_plane(chunk) -> None:
    frames, reconstruction = chunk
    geometric = LearnedDiscoverer()(frames, reconstruction, 5)
    flat = [k for k in range(len(geometric.score)) if np.isfinite(geometric.plane[k]).all()]
    views = chunk_views(frames, reconstruction, InstanceSettings())
    probability = np.stack([(geometric.labels == k + 1).astype(np.float32) for k in flat])
    masks = SoftMasks(probability, np.ones(len(flat), np.float32), np.ones((len(flat), 3), np.float32))
    found = choose_candidates(masks, views, 5)
    largest = int(np.argmax(np.bincount(found.labels.ravel())[1:]))
    assert np.isfinite(found.plane[largest]).all()
    agree = np.abs(geometric.plane[flat][:, :3] @ found.plane[largest][:3])
    assert agree.max() > 0.999


def test_names_of_what_bounds_a_room() -> None:
    assert all(bounds_the_room(n) for n in ("wall-brick", "floor-other-merged", "ceiling-merged", "wall", "Floor"))
    assert not any(bounds_the_room(n) for n in ("wallet", "cup", "dining table", "rug-merged"))


def _things(reconstruction, positions: list[int], labels: np.ndarray, most_live: int = 60) -> _Objects:
    frames, _ = walk(SCENE, 10)
    views = chunk_views(frames, reconstruction, InstanceSettings())
    count = int(labels.max())
    proposals = [
        Proposals(
            p, labels, np.ones(count, np.float32), np.eye(count, 8, dtype=np.float32), np.full((count, 4), np.nan)
        )
        for p in positions
    ]
    return _Objects(proposals, views, VideoTrackerSettings(most_live=most_live))


def test_ids_are_handed_over_by_overlap(chunk) -> None:
    _, reconstruction = chunk
    labels = np.zeros((240, 320), np.int32)
    labels[20:80, 20:80], labels[120:200, 150:260] = 1, 2
    things = _things(reconstruction, [0, 6, 9], labels)
    first = things.prompts(0, {}, forwards=True)
    assert sorted(first) == [0, 1] and not things.late
    followed = {0: np.where(first[0], 4.0, -4.0).astype(np.float32)}
    second = things.prompts(6, followed, forwards=True)
    assert things.joined[1].tolist() == [0, 2] and sorted(second) == [2]
    assert things.late == {2: 6}
    assert sorted(things.prompts(6, {}, forwards=False)) == [2]
    everything = {0: np.full(first[0].shape, 4.0, np.float32)}
    assert things.prompts(9, everything, forwards=True) == {}
    assert things.joined[2].tolist() == [-1, -1]


def test_the_surest_thing_takes_the_pixel(chunk) -> None:
    _, reconstruction = chunk
    things = _things(reconstruction, [0], np.ones((240, 320), np.int32))
    shape = things.shape
    things.keep(3, {0: np.full(shape, 1.0, np.float32), 1: np.full(shape, 2.0, np.float32)})
    things.keep(3, {2: np.full(shape, -1.0, np.float32)})
    assert (things.labels(3) == 2).all()


def test_names_of_a_discoverer_become_labels(tmp_path: Path) -> None:
    from list3r.memory.store.store import Store
    from list3r.pipeline.mapping import add_chunk
    from tests.conftest import box_points, chunk_result, local_instance

    mug = local_instance(0, box_points((0, 0, 2), (0.1, 0.1, 0.1), 300, 1), (200, 200, 200), np.arange(20))
    mug = replace(mug, names=(("cup", 0.95), ("cup", 0.9), ("bowl", 0.4), ("cup", 0.95)))
    once = local_instance(1, box_points((1, 0, 2), (0.2, 0.1, 0.1), 300, 2), (10, 200, 20), np.arange(20))
    once = replace(once, names=(("vase", 0.35),))
    with Store.create(tmp_path / "m.l3r") as store:
        with store.transaction():
            store.facts.scale_kind = "metric"
            store.facts.poses = "given"
            session = store.sessions.add("walk", "", {"poses": "given"}, 40)
        add_chunk(store, session, chunk_result(0, 0, 40, (mug, once)))
        labels = {i.label for i in store.instances.all(structure=False)}
    assert "cup" in labels and "vase" not in labels
