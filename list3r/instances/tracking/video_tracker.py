"""Masks followed through a chunk by a video tracker: SAM 2, SAM 3 or EdgeTAM of `transformers` (paper A.1).

One bounded state for each sweep: the memories that the network no longer reads are dropped, and when too many objects
are followed a new state begins with the visible ones, prompted by their own masks. An object first found on a later
anchor is followed backwards in a second sweep. Ids are handed over by the overlap of masks on anchors.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from list3r.frames.base import Frame
from list3r.instances.base import Proposals
from list3r.instances.geometric.support import collect_supports
from list3r.instances.geometric.views import ChunkViews, chunk_views
from list3r.instances.settings import InstanceSettings, VideoTrackerSettings
from list3r.instances.tracking.reprojection import LabelledChunk
from list3r.memory.core.records import LocalLibrary
from list3r.models.images import InputShape, network_input, sam_input
from list3r.models.pretrained import load_named
from list3r.reconstruction.base import Reconstruction

if TYPE_CHECKING:
    import torch

    Sessions = Callable[[], Any]

CLASSES = {
    "sam2": "Sam2VideoModel",
    "sam3": "Sam3TrackerVideoModel",
    "edgetam": "EdgeTamVideoModel",
}
SESSIONS = {
    "sam2": "Sam2VideoInferenceSession",
    "sam3": "Sam3TrackerVideoInferenceSession",
    "edgetam": "EdgeTamVideoInferenceSession",
}


class VideoTracker:
    """Tracker: candidates of the anchors prompt a network that propagates masks from frame to frame."""

    def __init__(
        self,
        model: str,
        folder: Path,
        device: str = "auto",
        settings: InstanceSettings | None = None,
    ) -> None:
        """`model` is sam2, sam3 or edgetam, `folder` holds its configuration and weights. Raises `OptionError`."""
        self._network, self._device = load_named(CLASSES, "tracking", model, folder, device)
        if model == "edgetam":
            _even_scores(self._network)
        self._session_class = SESSIONS[model]
        self._settings = settings or InstanceSettings()
        self._tracker = self._settings.video_tracker
        self._shape = sam_input(model, int(self._network.config.image_size))

    def __call__(
        self,
        frames: Sequence[Frame],
        reconstruction: Reconstruction,
        proposals: Sequence[Proposals],
        feature_space: str,
    ) -> LocalLibrary:
        """Follow all candidates through the posed frames, forwards and backwards; keep the stable tracks."""
        views = chunk_views(frames, reconstruction, self._settings)
        order = np.flatnonzero(reconstruction.posed).tolist()
        tracked = _Objects(proposals, views, self._tracker)
        for position, masks in self._sweep(frames, order, tracked, forwards=True):
            tracked.keep(position, masks)
        if tracked.late:
            for position, masks in self._sweep(frames, order[::-1], tracked, forwards=False):
                tracked.keep(position, masks)
        images = [tracked.labels(p.position) for p in proposals]
        supports = collect_supports(views, proposals, images, tracked.count, self._settings.track.support_points)
        chunk = LabelledChunk(views, proposals, tracked.joined, supports, self._settings)
        return chunk.library(tracked.labels, feature_space)

    def _sweep(
        self, frames: Sequence[Frame], order: Sequence[int], tracked: _Objects, *, forwards: bool
    ) -> Iterator[tuple[int, dict[int, NDArray[np.float32]]]]:
        """Logits (h, w) of every followed object at working size, frame by frame in the given order."""
        import torch

        state = _Inference(self._new_session(frames), self._network)
        with torch.inference_mode():
            for position in order:
                picture = network_input(frames[position].color, self._shape, self._device, self._network.dtype)
                found = state.step(picture, position, tracked.shape, reverse=not forwards)
                prompts = tracked.prompts(position, found, forwards=forwards)
                if prompts:
                    state, prompts = self._with_room(state, prompts, found, tracked, frames)
                    state.prompt(prompts, position, self._shape)
                    found = state.step(picture, position, tracked.shape, reverse=not forwards)
                state.forget(position)
                yield position, found

    def _with_room(
        self,
        state: _Inference,
        prompts: dict[int, NDArray[np.bool_]],
        found: Mapping[int, NDArray[np.float32]],
        tracked: _Objects,
        frames: Sequence[Frame],
    ) -> tuple[_Inference, dict[int, NDArray[np.bool_]]]:
        """Return the session that follows the prompts too, and the prompts: a new one where there would be too many."""
        if len(state.objects | prompts.keys()) <= self._tracker.most_live:
            return state, prompts
        live = {**{k: v > 0 for k, v in found.items() if (v > 0).any()}, **prompts}
        return _Inference(self._new_session(frames), self._network), tracked.most_wanted(live)

    def _new_session(self, frames: Sequence[Frame]) -> Any:
        import transformers

        height, width = frames[0].color.shape[:2]
        return getattr(transformers, self._session_class)(
            video=None,
            video_height=height,
            video_width=width,
            inference_device=self._device,
            inference_state_device=self._device,
            video_storage_device=self._device,
            dtype=self._network.dtype,
        )


def _even_scores(network: Any) -> None:
    """Give the score of a prompted and of a followed object one shape.

    EdgeTAM of transformers 5.23 returns them with different numbers of axes, and then cannot join them when both kinds
    are in one frame.
    """
    plain = network._run_single_frame_inference

    def even(*arguments: Any, **options: Any) -> Any:
        out = plain(*arguments, **options)
        out["object_score_logits"] = out["object_score_logits"].reshape(1, 1)
        return out

    network._run_single_frame_inference = even


class _Inference:
    """One inference session of the network, kept small."""

    def __init__(self, session: Any, network: Any) -> None:
        self._session, self._network = session, network
        self.objects: set[int] = set()
        config = network.config
        self._reach = max(int(config.num_maskmem), int(config.max_object_pointers_in_encoder)) + 1
        """Frames back that the network reads from its memory."""

    def step(
        self, picture: torch.Tensor, position: int, shape: tuple[int, int], *, reverse: bool
    ) -> dict[int, NDArray[np.float32]]:
        """Logits (h, w) of every object on a frame."""
        from torch.nn import functional

        self._session.add_new_frame(picture, position)
        if not self.objects:
            return {}
        out = self._network(inference_session=self._session, frame_idx=position, reverse=reverse)
        logits = out.pred_masks.float().reshape(-1, 1, *out.pred_masks.shape[-2:])
        logits = functional.interpolate(logits, size=shape, mode="bilinear", align_corners=False)[:, 0]
        return dict(zip(self._session.obj_ids, logits.cpu().numpy(), strict=True))

    def prompt(self, masks: dict[int, NDArray[np.bool_]], position: int, shape: InputShape) -> None:
        """Prompt the network with the masks (h, w) of objects on a frame."""
        import torch
        from torch.nn import functional

        for number, mask in masks.items():
            at = self._session.obj_id_to_idx(number)
            whole = torch.from_numpy(mask.astype(np.float32))[None, None]
            whole = functional.interpolate(whole, size=(shape.height, shape.width), mode="bilinear")
            self._session.add_mask_inputs(at, position, (whole >= 0.5).to(whole.dtype))
        self._session.obj_with_new_inputs = list(masks)
        self.objects |= masks.keys()

    def forget(self, position: int) -> None:
        """Drop the frame and the memories that no later frame reads."""
        self._session.processed_frames[position] = None  # its number still counts as a frame of the video
        self._session.cache.clear_all()
        for number in range(len(self.objects)):
            kept = self._session.output_dict_per_obj[number]["non_cond_frame_outputs"]
            for old in [k for k in kept if abs(k - position) > self._reach]:
                del kept[old]


class _Objects:
    """The followed objects: their candidates, and the frames that saw them."""

    def __init__(self, proposals: Sequence[Proposals], views: ChunkViews, settings: VideoTrackerSettings) -> None:
        self._anchors = {p.position: n for n, p in enumerate(proposals)}
        self._proposals, self._views, self._settings = proposals, views, settings
        self.joined = [np.full(len(p.score), -1, np.int64) for p in proposals]
        """Object of each candidate of each anchor, -1 for none."""
        self.count = 0
        self.shape = (views.camera.height, views.camera.width)
        self.late: dict[int, int] = {}
        """First anchor's position of objects that were not found on the first anchor."""
        self._best = {
            int(p): np.zeros(self.shape, np.float32) for p in np.flatnonzero(views.reconstruction.posed).tolist()
        }
        self._label = {p: np.zeros(self.shape, np.int32) for p in self._best}
        self._prompted: dict[tuple[int, int], NDArray[np.bool_]] = {}

    def prompts(
        self, position: int, found: dict[int, NDArray[np.float32]], *, forwards: bool
    ) -> dict[int, NDArray[np.bool_]]:
        """Objects that begin on a frame, with their masks (h, w): new ones forwards, the late ones backwards."""
        if position not in self._anchors:
            return {}
        if not forwards:
            return {k: self._prompted[position, k] for k, first in self.late.items() if first == position}
        return self._take(position, found)

    def _take(self, position: int, found: dict[int, NDArray[np.float32]]) -> dict[int, NDArray[np.bool_]]:
        """Give each candidate of an anchor to the object whose mask it overlaps, or make it a new object."""
        number = self._anchors[position]
        labels = self._proposals[number].labels[:: self._views.stride, :: self._views.stride]
        followed = {k: v > 0 for k, v in found.items()}
        covered = np.logical_or.reduce(list(followed.values())) if followed else np.zeros(self.shape, bool)
        new: dict[int, NDArray[np.bool_]] = {}
        for candidate in range(len(self._proposals[number].score)):
            mask = labels == candidate + 1
            area = int(mask.sum())
            iou = {k: (mask & m).sum() / max(1, (mask | m).sum()) for k, m in followed.items()}
            best = max(iou, key=lambda k: (iou[k], -k), default=-1)
            if best >= 0 and iou[best] >= self._settings.same_iou:
                self.joined[number][candidate] = best
            elif (mask & covered).sum() < self._settings.covered * area:
                self.joined[number][candidate] = self.count
                new[self.count] = mask
                self.count += 1
        self._prompted.update({(position, k): mask for k, mask in new.items()})
        if position != min(self._anchors):
            self.late.update(dict.fromkeys(new, position))
        return new

    def most_wanted(self, live: dict[int, NDArray[np.bool_]]) -> dict[int, NDArray[np.bool_]]:
        """Return the largest objects in view, as many as may be followed."""
        order = sorted(live, key=lambda k: (-int(live[k].sum()), k))
        return {k: live[k] for k in sorted(order[: self._settings.most_live])}

    def keep(self, position: int, masks: dict[int, NDArray[np.float32]]) -> None:
        """Give every pixel of a frame to the object that is surest of it."""
        best, label = self._best[position], self._label[position]
        for number, logits in masks.items():
            wins = logits > best
            label[wins] = number + 1
            best[wins] = logits[wins]

    def labels(self, position: int) -> NDArray[np.int32]:
        """Object + 1 of each pixel of a frame at working size (h, w), 0 for none."""
        return self._label[position]
