"""Small networks of the real architectures with random weights, saved as checkpoints are."""

from __future__ import annotations

from pathlib import Path
from typing import Any

SIZE = 128
HIERA = {
    "hidden_size": 8,
    "num_attention_heads": 1,
    "image_size": [SIZE, SIZE],
    "blocks_per_stage": [1, 1, 2, 1],
    "embed_dim_per_stage": [8, 16, 32, 64],
    "num_attention_heads_per_stage": [1, 1, 1, 1],
    "window_size_per_stage": [4, 4, 4, 4],
    "global_attention_blocks": [3],
    "window_positional_embedding_background_size": [4, 4],
}
DECODER = {"hidden_size": 128, "mlp_dim": 32, "num_attention_heads": 2, "iou_head_hidden_dim": 16}
FEATURE_SIZES = [[32, 32], [16, 16], [8, 8]]
MEMORY = {
    "memory_attention_hidden_size": 128,
    "memory_attention_num_layers": 1,
    "memory_encoder_hidden_size": 128,
    "memory_encoder_output_channels": 64,
    "mask_downsampler_embed_dim": 128,
    "memory_fuser_num_layers": 1,
    "memory_fuser_embed_dim": 128,
    "memory_fuser_intermediate_dim": 32,
}
ATTENTION = {"memory_attention_feed_forward_hidden_size": 32, "memory_attention_rope_feat_sizes": [8, 8]}
PERCEIVER = {
    "memory_attention_mlp_hidden_size": 32,
    "memory_attention_rope_feat_sizes": [8, 8],
    "memory_attention_rope_k_sizes": [4, 4],
    "perceiver_resampler_num_latents": 16,
    "perceiver_resampler_num_latents_2d": 16,
    "perceiver_resampler_hidden_size": 64,
    "perceiver_resampler_mlp_intermediate_size": 32,
    "perceiver_resampler_attention_head_dim": 64,
    "perceiver_resampler_num_layers": 1,
}
NAMES = {0: "cup", 1: "wall-brick", 2: "dining table"}


def save(name: str, folder: Path) -> Path:
    """A checkpoint of the model of that name in a new folder; the same weights at every call."""
    import torch
    from transformers.utils import logging

    logging.disable_progress_bar()
    torch.manual_seed(0)
    {**_MAKERS, "sam3": _sam3_whole}[name]().save_pretrained(folder)
    return folder


def _hiera() -> Any:
    from transformers.models.sam2.configuration_sam2 import Sam2HieraDetConfig, Sam2VisionConfig

    backbone = Sam2HieraDetConfig(**HIERA)
    return Sam2VisionConfig(
        backbone_config=backbone,
        backbone_channel_list=[64, 32, 16, 8],
        backbone_feature_sizes=FEATURE_SIZES,
        fpn_hidden_size=128,
    )


def _prompt(size: int = SIZE, patch: int = 16) -> dict[str, int]:
    return {"hidden_size": 128, "image_size": size, "patch_size": patch, "mask_input_channels": 4}


def _sam3_vision() -> dict[str, Any]:
    backbone = {
        "model_type": "sam3_vit_model",
        "hidden_size": 32,
        "intermediate_size": 64,
        "num_hidden_layers": 2,
        "num_attention_heads": 2,
        "image_size": 112,
        "patch_size": 14,
        "window_size": 4,
        "global_attn_indexes": [1],
        "pretrain_image_size": 56,
    }
    return {"backbone_config": backbone, "fpn_hidden_size": 128, "backbone_feature_sizes": FEATURE_SIZES}


def _sam2() -> Any:
    import transformers as t

    parts = {"vision_config": _hiera(), "prompt_encoder_config": _prompt(), "mask_decoder_config": DECODER}
    return t.Sam2Model(t.Sam2Config(**parts))


def _sam2_video() -> Any:
    import transformers as t

    parts = {"vision_config": _hiera(), "prompt_encoder_config": _prompt(), "mask_decoder_config": DECODER}
    return t.Sam2VideoModel(t.Sam2VideoConfig(**parts, **MEMORY, **ATTENTION, image_size=SIZE))


def _edgetam() -> Any:
    import transformers as t

    parts = {"vision_config": _hiera(), "prompt_encoder_config": _prompt(), "mask_decoder_config": DECODER}
    return t.EdgeTamVideoModel(t.EdgeTamVideoConfig(**parts, **MEMORY, **PERCEIVER, image_size=SIZE))


def _sam3() -> Any:
    import transformers as t

    parts = {"prompt_encoder_config": _prompt(112, 14), "mask_decoder_config": DECODER}
    return t.Sam3TrackerModel(t.Sam3TrackerConfig(vision_config=_sam3_vision(), **parts))


def _sam3_video() -> Any:
    import transformers as t

    parts = {"prompt_encoder_config": _prompt(112, 14), "mask_decoder_config": DECODER}
    config = t.Sam3TrackerVideoConfig(vision_config=_sam3_vision(), **parts, **MEMORY, **ATTENTION, image_size=112)
    return t.Sam3TrackerVideoModel(config)


def _sam3_whole() -> Any:
    """As the published weights are: a detector and a tracker in one."""
    import transformers as t

    small = {"hidden_size": 128, "num_attention_heads": 2, "intermediate_size": 32}
    words = {"vocab_size": 64, "hidden_size": 32, "intermediate_size": 32, "num_hidden_layers": 1}
    detector = {
        "vision_config": _sam3_vision(),
        "text_config": {**words, "num_attention_heads": 2, "max_position_embeddings": 16, "projection_dim": 32},
        "geometry_encoder_config": {**small, "num_layers": 1},
        "detr_encoder_config": {**small, "num_layers": 1},
        "detr_decoder_config": {**small, "num_layers": 1, "num_queries": 4},
        "mask_decoder_config": {"hidden_size": 128, "num_upsampling_stages": 1, "num_attention_heads": 2},
    }
    parts = {"prompt_encoder_config": _prompt(112, 14), "mask_decoder_config": DECODER}
    tracker = {"vision_config": _sam3_vision(), **parts, **MEMORY, **ATTENTION, "image_size": 112}
    return t.Sam3VideoModel(t.Sam3VideoConfig(detector_config=detector, tracker_config=tracker))


def _eomt() -> Any:
    import transformers as t

    config = t.EomtConfig(
        hidden_size=32,
        num_hidden_layers=4,
        num_attention_heads=2,
        image_size=64,
        patch_size=8,
        num_blocks=2,
        num_queries=12,
        num_upscale_blocks=1,
        id2label=NAMES,
    )
    return t.EomtForUniversalSegmentation(config)


def _mask2former() -> Any:
    import transformers as t

    stages = ["stage1", "stage2", "stage3", "stage4"]
    swin = t.SwinConfig(
        image_size=64, embed_dim=16, depths=[1, 1, 1, 1], num_heads=[1, 2, 2, 4], window_size=4, out_features=stages
    )
    config = t.Mask2FormerConfig(
        backbone_config=swin,
        feature_size=32,
        mask_feature_size=32,
        hidden_dim=32,
        encoder_feedforward_dim=64,
        encoder_layers=1,
        decoder_layers=2,
        num_attention_heads=2,
        dim_feedforward=64,
        num_queries=10,
        id2label=NAMES,
    )
    return t.Mask2FormerForUniversalSegmentation(config)


def _dinov2() -> Any:
    import transformers as t

    return t.Dinov2Model(t.Dinov2Config(hidden_size=32, num_hidden_layers=2, num_attention_heads=2, image_size=56))


def _dinov3() -> Any:
    import transformers as t

    config = t.DINOv3ViTConfig(
        hidden_size=32,
        num_hidden_layers=2,
        num_attention_heads=2,
        image_size=64,
        patch_size=16,
        intermediate_size=64,
        num_register_tokens=4,
    )
    return t.DINOv3ViTModel(config)


_MAKERS = {
    "discovery/eomt": _eomt,
    "discovery/mask2former": _mask2former,
    "discovery/sam2": _sam2,
    "discovery/sam3": _sam3,
    "tracking/sam2": _sam2_video,
    "tracking/sam3": _sam3_video,
    "tracking/edgetam": _edgetam,
    "features/dinov2": _dinov2,
    "features/dinov3": _dinov3,
}


def save_text_image(kind: str, folder: Path) -> Path:
    """A small CLIP or SigLIP with a tokenizer that knows a few words."""
    import torch
    import transformers as t
    from tokenizers import Tokenizer, models, pre_tokenizers

    torch.manual_seed(0)
    words = ["[PAD]", "[UNK]", "[END]", "a", "photo", "of", "mug", "red", "chair", "table"]
    tokenizer = Tokenizer(models.WordLevel({w: n for n, w in enumerate(words)}, unk_token="[UNK]"))
    tokenizer.pre_tokenizer = pre_tokenizers.Whitespace()
    fast = t.PreTrainedTokenizerFast(
        tokenizer_object=tokenizer, unk_token="[UNK]", pad_token="[PAD]", eos_token="[END]", model_max_length=64
    )
    text = {"vocab_size": 12, "hidden_size": 16, "intermediate_size": 16, "num_hidden_layers": 1}
    text |= {"num_attention_heads": 2, "max_position_embeddings": 64, "eos_token_id": 2, "pad_token_id": 0}
    vision = {"hidden_size": 16, "intermediate_size": 16, "num_hidden_layers": 1, "num_attention_heads": 2}
    vision |= {"image_size": 32, "patch_size": 8}
    if kind == "clip":
        network: Any = t.CLIPModel(t.CLIPConfig(text_config=text, vision_config=vision, projection_dim=16))
    else:
        network = t.SiglipModel(t.SiglipConfig(text_config=text, vision_config=vision))
    network.save_pretrained(folder)
    fast.save_pretrained(folder)
    return folder
