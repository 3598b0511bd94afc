"""Small networks of the geometry packages' own classes, and heads of theirs that are told what a film shows.

Code and shapes are the packages'; only depths and widths are cut where their constructors fix them. `teach` replaces
what the last layers put out, before the packages' own activations and assembly, so that those run on known geometry.
"""

from __future__ import annotations

import functools
import json
import math
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from scipy.spatial.transform import Rotation
from torch.nn import functional

from list3r.frames.base import Camera, Frame

SCALE = 1.7
"""Of the taught geometry, in metres of the film."""
SURE = 3.0
"""Logit of the confidence in taught depth."""
_MEAN, _STD = torch.tensor([0.485, 0.456, 0.406]).view(3, 1, 1), torch.tensor([0.229, 0.224, 0.225]).view(3, 1, 1)


class Truth:
    """What the film shows, looked up by the pictures that a network is given."""

    def __init__(self, frames: tuple[Frame, ...], camera: Camera) -> None:
        self._thumbnails = torch.stack([_thumbnail(torch.from_numpy(f.color).permute(2, 0, 1) / 255.0) for f in frames])
        self._depth = torch.from_numpy(np.stack([f.depth for f in frames if f.depth is not None]))
        self._T = torch.from_numpy(np.stack([f.T_source_cam for f in frames if f.T_source_cam is not None])).float()
        self._camera = camera
        self.most, self.passes = 10_000, 0
        """Pictures that a pass holds; more run out of memory."""

    def look(self, pictures: torch.Tensor) -> None:
        """Note what pictures (n, 3, h, w) in [0, 1] show; their first camera is the frame of reference."""
        self.passes += 1
        if len(pictures) > self.most:
            raise torch.OutOfMemoryError(f"out of memory: {len(pictures)} pictures")
        assert -1e-3 <= float(pictures.min()) and float(pictures.max()) <= 1.001
        small = torch.stack([_thumbnail(p) for p in pictures])
        at = torch.cdist(small.flatten(1), self._thumbnails.flatten(1)).argmin(dim=1)
        self.height, self.width = pictures.shape[-2:]
        size = (self.height, self.width)
        self.depth = SCALE * functional.interpolate(self._depth[at][:, None], size=size, mode="nearest-exact")[:, 0]
        self.T = torch.linalg.inv(self._T[at[0]]) @ self._T[at]
        self.T[:, :3, 3] *= SCALE
        self.fx = self._camera.fx * self.width / self._camera.width
        self.fy = self._camera.fy * self.height / self._camera.height
        self.K = torch.tensor([[self.fx, 0, self.width / 2], [0, self.fy, self.height / 2], [0, 0, 1]])
        self._done: dict[str, int] = {}

    def next(self, name: str, values: torch.Tensor, count: int) -> torch.Tensor:
        """The next `count` rows of values: heads take a few pictures at a time."""
        start = self._done.get(name, 0)
        self._done[name] = start + count
        return values[start : start + count]

    def z(self) -> torch.Tensor:
        """Depth (n, h, w), 1 where there is none."""
        return torch.where(self.depth > 0, self.depth, 1.0)

    def logit(self) -> torch.Tensor:
        """Of the confidence (n, h, w)."""
        return torch.where(self.depth > 0, SURE, -6.0)

    def slopes(self) -> torch.Tensor:
        """x / z and y / z of every pixel (h, w, 2); the first pixel's centre is half a pixel off the corner."""
        x = (torch.arange(self.width) + 0.5 - self.width / 2) / self.fx
        y = (torch.arange(self.height) + 0.5 - self.height / 2) / self.fy
        return torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1)

    def quat_xyzw(self) -> torch.Tensor:
        """Of the camera-to-world rotations (n, 4)."""
        return torch.from_numpy(Rotation.from_matrix(self.T[:, :3, :3].numpy()).as_quat()).float()


def _thumbnail(picture: torch.Tensor) -> torch.Tensor:
    return functional.adaptive_avg_pool2d(picture[None].float(), 12)[0]


def _hook(module: Any, make: Callable[[Any], Any]) -> None:
    module.register_forward_hook(lambda _module, _inputs, out: make(out))


def _first_pictures(module: Any, truth: Truth, restore: Callable[[torch.Tensor], torch.Tensor]) -> None:
    def before(_module: Any, inputs: tuple[Any, ...], named: dict[str, Any]) -> None:
        truth.look(restore((inputs[0] if inputs else named["imgs"])[0]))

    module.register_forward_pre_hook(before, with_kwargs=True)


def _teach_pi3(model: Any, truth: Truth) -> None:
    _first_pictures(model, truth, lambda p: p)

    def points(out: Any) -> Any:
        slopes, z = truth.slopes().expand(*truth.depth.shape, 2), truth.z().log()[..., None]
        if isinstance(out, torch.Tensor):
            return torch.cat([slopes, z], dim=-1)
        slopes, z = (truth.next(name, t, len(out[0])) for name, t in (("slopes", slopes), ("z", z)))
        return [slopes.permute(0, 3, 1, 2), z.permute(0, 3, 1, 2)]

    def confidence(out: Any) -> Any:
        said = truth.logit()[..., None]
        if isinstance(out, torch.Tensor):
            return said
        return [truth.next("confidence", said, len(out[0])).permute(0, 3, 1, 2)]

    _hook(model.point_head, points)
    _hook(model.conf_head, confidence)
    _hook(model.camera_head.fc_t, lambda out: truth.T[:, :3, 3])
    _hook(model.camera_head.fc_rot, lambda out: truth.T[:, :3, :3].reshape(-1, 9))
    if hasattr(model, "metric_head"):
        _hook(model.metric_head, lambda out: torch.full_like(out, math.log(1.3)))


def _raw_depth(truth: Truth, out: torch.Tensor) -> torch.Tensor:
    return truth.next("depth", torch.stack([truth.z().log(), truth.logit()], dim=1), len(out))


def _teach_vggt(model: Any, truth: Truth) -> None:
    encode = import_module("vggt.utils.pose_enc").extri_intri_to_pose_encoding
    _first_pictures(model, truth, lambda p: p)

    def pose(out: torch.Tensor) -> torch.Tensor:
        cam = torch.linalg.inv(truth.T)[None, :, :3]
        whole = encode(cam, truth.K.expand(1, len(truth.T), 3, 3), (truth.height, truth.width))
        first = truth.next("pose", torch.arange(8), 1) == 0  # what follows refines the first guess
        return whole if bool(first) else torch.zeros_like(whole)

    _hook(model.camera_head.pose_branch, pose)
    _hook(model.depth_head.scratch.output_conv2, lambda out: _raw_depth(truth, out))


def _teach_da3(model: Any, truth: Truth) -> None:
    encode = import_module("depth_anything_3.model.utils.transform").extri_intri_to_pose_encoding
    net = model.model
    _first_pictures(net, truth, lambda p: p * _STD + _MEAN)

    def encoding(part: slice) -> Callable[[torch.Tensor], torch.Tensor]:
        def say(out: torch.Tensor) -> torch.Tensor:
            K = truth.K.expand(1, len(truth.T), 3, 3)
            whole: torch.Tensor = encode(truth.T[None, :, :3], K, (truth.height, truth.width))
            return whole[0, :, part]

        return say

    for layer, part in (("fc_t", slice(0, 3)), ("fc_qvec", slice(3, 7)), ("fc_fov", slice(7, 9))):
        _hook(getattr(net.cam_dec, layer), encoding(part))
    _hook(net.head.scratch.output_conv2, lambda out: _raw_depth(truth, out))


def _teach_mapanything(model: Any, truth: Truth) -> None:
    encode, metric = model._encode_n_views, 1.3

    def look(views: Any) -> Any:
        truth.look(torch.cat([v["img"] for v in views]) * _STD + _MEAN)
        return encode(views)

    def dense(out: Any) -> Any:
        rays = torch.cat([truth.slopes(), torch.ones(truth.height, truth.width, 1)], dim=-1)
        length = rays.norm(dim=-1)
        along = (truth.z() * length / metric).log()
        channels = [
            (rays / length[..., None]).expand(*truth.depth.shape, 3),
            along[..., None],
            truth.logit()[..., None],
        ]
        raw = torch.cat([*channels, torch.where(truth.depth > 0, 4.0, -4.0)[..., None]], dim=-1).permute(0, 3, 1, 2)
        out.decoded_channels = truth.next("dense", raw, len(out.decoded_channels))
        return out

    def pose(out: Any) -> Any:
        raw = torch.cat([truth.T[:, :3, 3] / metric, truth.quat_xyzw()], dim=1)
        out.decoded_channels = truth.next("pose", raw, len(out.decoded_channels))
        return out

    def scale(out: Any) -> Any:
        out.decoded_channels = torch.full_like(out.decoded_channels, math.log(metric))
        return out

    model._encode_n_views = look
    for head, make in ((model.dense_head, dense), (model.pose_head, pose), (model.scale_head, scale)):
        _hook(head, make)


def _grown(values: torch.Tensor) -> torch.Tensor:
    """What grows to values (..., 3) where a package makes x expm1(|x|) / |x| of x."""
    length = values.norm(dim=-1, keepdim=True).clamp(min=1e-8)
    return values / length * torch.log1p(length)


def _raw_points(truth: Truth, points: torch.Tensor, rows: slice) -> torch.Tensor:
    """Points (n, h, w, 3) and confidence before a head's activations. Shape (n, 4, h, w)."""
    raw = torch.cat([_grown(points), truth.logit()[rows][..., None]], dim=-1)
    return raw.permute(0, 3, 1, 2)


def _tokens(raw: torch.Tensor) -> torch.Tensor:
    """What a head of one linear layer says in its tokens (n, s, c) of maps (n, c', h, w)."""
    return functional.pixel_unshuffle(raw, 16).flatten(2).transpose(1, 2)


def _local_points(truth: Truth) -> torch.Tensor:
    slopes = truth.slopes()
    return truth.z()[..., None] * torch.cat([slopes, torch.ones_like(slopes[..., :1])], dim=-1)


def _teach_cut3r(model: Any, truth: Truth) -> None:
    def before(_module: Any, inputs: tuple[Any, ...]) -> None:
        truth.look(torch.cat([(v["img"] + 1) / 2 for v in inputs[0]]))

    def pose(out: torch.Tensor) -> torch.Tensor:
        quat = truth.quat_xyzw()[:, [3, 0, 1, 2]]
        return truth.next("pose", torch.cat([_grown(truth.T[:, :3, 3]), quat], dim=1), len(out))

    def own(out: torch.Tensor) -> torch.Tensor:
        return truth.next("own", _tokens(_raw_points(truth, _local_points(truth), slice(None))), len(out))

    model.register_forward_pre_hook(before)
    _hook(model.downstream_head.pose_head, pose)
    _hook(model.downstream_head.proj, own)


def _teach_dust3r(model: Any, truth: Truth) -> None:
    def before(_module: Any, inputs: tuple[Any, ...]) -> None:
        truth.look(torch.cat([(v["img"] + 1) / 2 for v in inputs]))

    def head(second: bool, tokens: bool) -> Callable[[torch.Tensor], torch.Tensor]:
        def say(_out: torch.Tensor) -> torch.Tensor:
            half = len(truth.T) // 2
            rows = slice(half, None) if second else slice(0, half)
            local = _local_points(truth)[rows]
            T = torch.linalg.inv(truth.T[:half]) @ truth.T[rows]
            seen = torch.einsum("nij,nhwj->nhwi", T[:, :3, :3], local) + T[:, None, None, :3, 3]
            raw = _raw_points(truth, seen, rows)
            return _tokens(raw) if tokens else raw

        return say

    model.register_forward_pre_hook(before)
    for n, module in enumerate((model.downstream_head1, model.downstream_head2)):
        linear = hasattr(module, "proj")
        _hook(module.proj if linear else module.head_pts3d, head(n == 1, linear))


def _teach_fast3r(model: Any, truth: Truth) -> None:
    def before(_module: Any, inputs: tuple[Any, ...]) -> None:
        truth.look(torch.cat([(v["img"] + 1) / 2 for v in inputs[0]]))

    def head(common: bool) -> Callable[[torch.Tensor], torch.Tensor]:
        def say(out: torch.Tensor) -> torch.Tensor:
            points, T = _local_points(truth), truth.T
            if common:
                points = torch.einsum("nij,nhwj->nhwi", T[:, :3, :3], points) + T[:, None, None, :3, 3]
            return truth.next(f"common {common}", _raw_points(truth, points, slice(None)), len(out))

        return say

    model.register_forward_pre_hook(before)
    _hook(model.downstream_head.dpt, head(True))
    _hook(model.downstream_head_local.dpt, head(False))


TEACHERS: dict[str, Callable[[Any, Truth], None]] = {
    "pi3": _teach_pi3,
    "pi3x": _teach_pi3,
    "vggt": _teach_vggt,
    "mapanything": _teach_mapanything,
    "da3": _teach_da3,
    "dust3r": _teach_dust3r,
    "mast3r": _teach_dust3r,
    "cut3r": _teach_cut3r,
    "ttt3r": _teach_cut3r,
    "fast3r": _teach_fast3r,
}


def cut_down(name: str, patch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Make a package's classes build small networks; what the constructor is to be told."""
    if name in ("pi3", "pi3x"):
        module = import_module(f"pi3.models.{name}")
        _shallow(patch, "pi3.models.dinov2.models.vision_transformer")
        patch.setattr(module, "range", _two_layers, raising=False)
        for decoder in ("TransformerDecoder", "ContextOnlyTransformerDecoder"):
            if hasattr(module, decoder):
                patch.setattr(module, decoder, functools.partial(getattr(module, decoder), depth=1))
        return {}
    if name == "vggt":
        module = import_module("vggt.models.vggt")
        _shallow(patch, "vggt.layers.vision_transformer", embed_dim=64, num_heads=4)
        layers = {"intermediate_layer_idx": [0, 1, 2, 3], "features": 16, "out_channels": [16] * 4}
        patch.setattr(module, "Aggregator", functools.partial(module.Aggregator, depth=4))
        patch.setattr(module, "CameraHead", functools.partial(module.CameraHead, trunk_depth=1))
        patch.setattr(module, "DPTHead", functools.partial(module.DPTHead, **layers))
        return {"embed_dim": 64}
    if name in ("dust3r", "mast3r", "cut3r", "ttt3r"):
        return _croco(name)
    if name == "fast3r":
        return _fast3r()
    return {"model_name": "da3-small"} if name == "da3" else _mapanything()


def _croco(name: str) -> dict[str, Any]:
    """Networks after CroCo, narrower and with fewer layers."""
    plan: dict[str, Any] = {
        "pos_embed": "RoPE100",
        "patch_embed_cls": "PatchEmbedDust3R",
        "img_size": (96, 128),
        "head_type": "linear",
        "output_mode": "pts3d",
        "depth_mode": ("exp", -math.inf, math.inf),
        "conf_mode": ("exp", 1, math.inf),
        "enc_embed_dim": 32,
        "enc_depth": 1,
        "enc_num_heads": 2,
        "dec_embed_dim": 32,
        "dec_depth": 4,
        "dec_num_heads": 2,
        "landscape_only": False,
    }
    if name == "dust3r":
        return plan
    if name == "mast3r":
        return plan | {"head_type": "catconv", "output_mode": "pts3d+desc24", "two_confs": True}
    state = {"state_size": 16, "state_pe": "2d", "local_mem_size": 8, "state_dec_num_heads": 2, "rgb_head": False}
    return plan | state | {"output_mode": "pts3d+pose", "pose_head": True, "pose_mode": plan["depth_mode"]}


def _fast3r() -> dict[str, Any]:
    """The plan of the published weights, narrower and with fewer layers; its head asks for ten in the decoder."""
    small = {"embed_dim": 32, "num_heads": 2, "mlp_ratio": 4, "attn_implementation": "pytorch_naive"}
    encoder = {"encoder_type": "croco", "img_size": 512, "patch_size": 16, "patch_embed_cls": "ManyAR_PatchEmbed"}
    modes = {"depth_mode": ("exp", -math.inf, math.inf), "conf_mode": ("exp", 1, math.inf)}
    return {
        "encoder_args": encoder | small | {"depth": 1, "pos_embed": "RoPE100"},
        "decoder_args": {"random_image_idx_embedding": True, "enc_embed_dim": 32, "depth": 10} | small,
        "head_args": modes
        | {"head_type": "dpt", "output_mode": "pts3d", "patch_size": 16, "landscape_only": True}
        | {"with_local_head": True},
    }


def _two_layers(*ends: int) -> range:
    """`range`, for loops that make layers."""
    return range(min(ends[0], 2)) if len(ends) == 1 else range(*ends)


def _shallow(patch: pytest.MonkeyPatch, module: str, **sizes: int) -> None:
    layers = import_module(module)
    whole = layers.DinoVisionTransformer
    patch.setattr(layers, "DinoVisionTransformer", lambda **given: whole(**{**given, "depth": 1, **sizes}))


def _mapanything() -> dict[str, Any]:
    """The plan of the published weights, narrower and with fewer layers."""
    small = {"dim": 384, "num_heads": 6, "mlp_ratio": 4, "qkv_bias": True, "qk_norm": False, "init_values": 1e-5}
    layers = {"name": "small", "indices": [1, 2], "norm_intermediate": True, "size": "small", "depth": 4}
    views = {"distinguish_ref_and_non_ref_views": True, "gradient_checkpointing": False}
    everything = {"name": "all"}
    dense = {
        "ray_directions_mode": "linear",
        "ray_directions_normalize_to_unit_sphere": True,
        "ray_directions_normalize_to_unit_image_plane": False,
        "ray_directions_vmin": -math.inf,
        "ray_directions_vmax": math.inf,
        "ray_directions_clamp_min_of_z_dir": False,
        "ray_directions_z_dir_min": -math.inf,
        "depth_mode": "exp",
        "depth_vmin": 0,
        "depth_vmax": math.inf,
        "confidence_type": "exp",
        "confidence_vmin": 1,
        "confidence_vmax": math.inf,
    }
    pose = {"cam_trans_mode": "linear", "cam_trans_vmin": -math.inf, "cam_trans_vmax": math.inf}
    turn = {"quaternions_mode": "linear", "quaternions_normalize": True}
    limits = {"quaternions_vmin": -math.inf, "quaternions_vmax": math.inf}
    rates = ("overall", "ray_dirs", "depth", "cam", "sparse_depth", "depth_scale_norm_all", "pose_scale_norm_all")
    encoders = {
        "ray_dirs_encoder_config": ("dense_rep_encoder", 3, {"apply_pe": False}),
        "depth_encoder_config": ("dense_rep_encoder", 1, {"apply_pe": False}),
        "cam_rot_encoder_config": ("global_rep_encoder", 4, {}),
        "cam_trans_encoder_config": ("global_rep_encoder", 3, {}),
        "scale_encoder_config": ("global_rep_encoder", 1, {}),
    }
    told = {
        key: {"name": key, "in_chans": channels, "encoder_str": kind, **more}
        for key, (kind, channels, more) in encoders.items()
    }
    return {
        "name": "mapanything",
        "encoder_config": {
            "encoder_str": "dinov2",
            "name": "dinov2_small",
            "data_norm_type": "dinov2",
            "size": "small",
            "with_registers": False,
            "uses_torch_hub": True,
            "gradient_checkpointing": False,
            "norm_returned_features": False,
            "keep_first_n_layers": 2,
        },
        "info_sharing_config": {
            "model_type": "alternating_attention",
            "model_return_type": "intermediate_features",
            "custom_positional_encoding": None,
            "module_args": {**layers, **views, **small},
        },
        "pred_head_config": {
            "type": "dpt+pose",
            "feature_head": {"feature_dim": 32, "hooks": [0, 1, 2, 3], "checkpoint_gradient": False},
            "regressor_head": {"output_dim": 6, "checkpoint_gradient": False},
            "pose_head": {"num_resconv_block": 1, "rot_representation_dim": 4},
            "scale_head": {"output_dim": 1},
            "adaptor_type": "raydirs+depth+pose+confidence+mask",
            "dpt_adaptor": {**everything, **dense},
            "pose_adaptor": {**everything, **pose, **turn, **limits},
            "scale_adaptor": {**everything, "mode": "exp", "vmin": 1e-8, "vmax": math.inf},
            "adaptor_config": {"input_dim": 6, "scene_rep_dim": 4, "scene_rep_type": "raydirs+depth+pose"},
        },
        "geometric_input_config": {
            **{f"{rate}_prob": 0.0 for rate in rates},
            "dropout_prob": 1.0,
            "sparsification_removal_percent": 0.0,
            **told,
        },
        "use_register_tokens_from_encoder": True,
        "info_sharing_mlp_layer_str": "swiglufused",
    }


def save(cls: Any, told: dict[str, Any], folder: Path) -> Path:
    """A network of the class with random weights, as its authors' repositories have theirs; the folder."""
    import copy

    torch.manual_seed(0)
    if hasattr(cls, "config_class"):  # of transformers, whose own way of saving its configuration cannot hold
        folder.mkdir(parents=True)
        save_file(cls(cls.config_class(**copy.deepcopy(told))).state_dict(), folder / "model.safetensors")
        (folder / "config.json").write_text(json.dumps(told), encoding="utf-8")
        return folder
    model = cls(**copy.deepcopy(told))
    model.save_pretrained(folder, config=told)
    return folder
