"""Every neural model: its licence, the place of its weights, its needs, and its published memory.

A card names facts that others published; nothing here loads a model. Code and weights have licences of their own, and
both count. A revision is a commit that public pages name; where none does the weights are `unpinned`, and the fetched
commit is used from then on (`cache`).
"""

from __future__ import annotations

from dataclasses import dataclass

from list3r.memory.core.errors import OptionError, install_hint

PARTS = ("geometry", "discovery", "tracking", "features", "text", "detector", "local features", "descriptor")
"""The parts of a pipeline that a model can serve."""

UNPINNED = "main"
"""Branch used where no revision is known."""


@dataclass(frozen=True)
class Licence:
    """Terms under which code or weights may be used."""

    name: str
    """SPDX identifier, or the owner's own name for it."""
    kind: str
    """permissive, noncommercial, copyleft, custom (its own terms), or none (no licence was given)."""

    def __post_init__(self) -> None:
        assert self.kind in ("permissive", "noncommercial", "copyleft", "custom", "none")


APACHE = Licence("Apache-2.0", "permissive")
MIT = Licence("MIT", "permissive")
BSD3 = Licence("BSD-3-Clause", "permissive")
CC_BY_NC = Licence("CC-BY-NC-4.0", "noncommercial")
CC_BY_NC_SA = Licence("CC-BY-NC-SA-4.0", "noncommercial")
FAIR_NC = Licence("FAIR Noncommercial Research License", "noncommercial")
VGGT_LICENCE = Licence("VGGT License v1", "custom")
SAM_LICENCE = Licence("SAM License", "custom")
DINOV3_LICENCE = Licence("DINOv3 License", "custom")
OTHER = Licence("other (see its repository)", "custom")


@dataclass(frozen=True)
class MemoryFigures:
    """Published GPU memory: fixed + per_megapixel for each million pixels of all pictures at the network's size."""

    fixed_mb: float
    per_megapixel_mb: float
    source: str
    """Who measured it, on what."""

    def needed_mb(self, pictures: int, pixels: int) -> float:
        """Memory of one pass over this many pictures of `pixels` pixels."""
        return self.fixed_mb + self.per_megapixel_mb * pictures * pixels / 1e6


@dataclass(frozen=True)
class Weights:
    """Weights of a model on the hub."""

    repository: str
    """`owner/name`."""
    licence: Licence
    gated: bool = False
    """Its owner must first grant access, with an account."""
    revision: str = UNPINNED
    """Commit of the repository, or `main` where none is known."""
    files: tuple[str, ...] = ("*.json", "*.safetensors", "*.txt", "*.model")
    """Patterns of the files that are needed."""
    memory: MemoryFigures | None = None
    """Set where these need another amount than the card states."""

    @property
    def pinned(self) -> bool:
        """Whether the revision is one commit."""
        return self.revision != UNPINNED


@dataclass(frozen=True)
class ModelCard:
    """One model that an option can name."""

    name: str
    part: str
    code: Licence
    """Licence of the package that runs it."""
    weights: tuple[Weights, ...]
    """Published weights; the first are used unless others are asked for. Empty where the user brings weights."""
    packages: tuple[str, ...]
    """Modules that must be importable."""
    install: str
    """The command that installs them; packages in addition to `extra`, where that is given."""
    memory: MemoryFigures | None = None
    pixels: int = 0
    """Pixels of its pictures, at most, where `memory` is known."""
    about: str = ""
    """One line on its use."""
    extra: str | None = None
    """Extra of this program that brings them."""

    def __post_init__(self) -> None:
        assert self.part in PARTS

    def memory_with(self, weights: str | None) -> MemoryFigures | None:
        """Published memory with weights named `owner/name` or `owner/name@revision`; None means the first ones."""
        if weights is None:
            known = self.weights[0] if self.weights else None
        else:
            known = find_weights(self, weights.partition("@")[0])
        return self.memory if known is None or known.memory is None else known.memory

    @property
    def installed_by(self) -> str:
        """The command that installs its packages."""
        return self.install if self.extra is None else install_hint(self.extra, *self.install.split())

    @property
    def commercial(self) -> bool:
        """Whether code and default weights allow commercial use without asking anyone."""
        terms = (self.code, *(w.licence for w in self.weights[:1]))
        return all(t.kind == "permissive" for t in terms) and not any(w.gated for w in self.weights[:1])


SAM2_COMMIT = "de431c4043854a71d8101e17995dfe596bf101a5"
SAM3_COMMIT = "3c879f39826c281e95690f02c7821c4de09afae7"
_TRANSFORMERS = ("transformers",)
_GIT = "pip install git+https://github.com"


def _hub(name: str, part: str, weights: Weights, about: str, also: tuple[str, ...] = ()) -> ModelCard:
    """Return the card of a model that the package transformers runs, with the help of other packages."""
    packages = (*_TRANSFORMERS, *also)
    return ModelCard(name, part, APACHE, (weights,), packages, " ".join(also), about=about, extra="models")


DA3_SMALLER = MemoryFigures(2500, 600, "weights counted (0.14 G parameters); the rest as the giant's")

CARDS: tuple[ModelCard, ...] = (
    ModelCard(
        "pi3",
        "geometry",
        BSD3,
        (Weights("yyfz233/Pi3", CC_BY_NC, revision="ae722e7039287d0c8fde9f11f197f804f44b510c"),),
        ("pi3",),
        f"{_GIT}/yyfz/Pi3",
        MemoryFigures(3658, 212, "its authors' capacity table, A800, bfloat16"),
        255_000,
        "the paper's model",
    ),
    ModelCard(
        "pi3x",
        "geometry",
        BSD3,
        (Weights("yyfz233/Pi3X", CC_BY_NC, revision="bb1deea4d7423de5b30691739cb451a3f57dc1d5"),),
        ("pi3",),
        f"{_GIT}/yyfz/Pi3",
        MemoryFigures(5190, 212, "its authors' capacity table, A800, bfloat16, and the weights for known inputs"),
        255_000,
        "smoother than pi3, takes known intrinsics and poses",
    ),
    ModelCard(
        "vggt",
        "geometry",
        VGGT_LICENCE,
        (
            Weights("facebook/VGGT-1B", CC_BY_NC, revision="860abec7937da0a4c03c41d3c269c366e82abdf9"),
            Weights("facebook/VGGT-1B-Commercial", VGGT_LICENCE, gated=True),
        ),
        ("vggt",),
        f"{_GIT}/facebookresearch/vggt",
        MemoryFigures(
            9200, 1075, "its README, H100: 0.19 GB a frame before the heads; all weights and one head counted"
        ),
        518 * 392,
        "first frame is the frame of reference",
    ),
    ModelCard(
        "mapanything",
        "geometry",
        APACHE,
        (
            Weights("facebook/map-anything-apache", APACHE, revision="00f9c245bbcb60522d1ed7f9e9d88462c6e3f38a"),
            Weights("facebook/map-anything", CC_BY_NC),
        ),
        ("mapanything",),
        f"{_GIT}/facebookresearch/map-anything",
        MemoryFigures(9800, 330, "its README: 2,000 views in 140 GB, memory-efficient mode; weights and head counted"),
        518 * 392,
        "takes known intrinsics",
    ),
    ModelCard(
        "da3",
        "geometry",
        APACHE,
        (
            Weights(
                "depth-anything/DA3-BASE",
                APACHE,
                revision="f4a6c9b3c95e41c82048423d3493a81ec3fa810e",
                memory=DA3_SMALLER,
            ),
            Weights("depth-anything/DA3-SMALL", APACHE, memory=DA3_SMALLER),
            Weights("depth-anything/DA3-LARGE-1.1", CC_BY_NC),
            Weights("depth-anything/DA3-GIANT-1.1", CC_BY_NC),
            Weights("depth-anything/DA3NESTED-GIANT-LARGE-1.1", CC_BY_NC),
        ),
        ("depth_anything_3",),
        f"{_GIT}/ByteDance-Seed/Depth-Anything-3",
        MemoryFigures(10000, 600, "DA3-Streaming's table, giant weights: 28.3 GB at 120 frames of 504x378"),
        504 * 378,
        "base and small weights are free for any use",
    ),
    ModelCard(
        "dust3r",
        "geometry",
        CC_BY_NC_SA,
        (Weights("naver/DUSt3R_ViTLarge_BaseDecoder_512_dpt", CC_BY_NC_SA),),
        ("dust3r",),
        "git clone --recursive https://github.com/naver/dust3r, and its folder on PYTHONPATH",
        about="pairs of pictures, brought into chunks here",
    ),
    ModelCard(
        "mast3r",
        "geometry",
        CC_BY_NC_SA,
        (Weights("naver/MASt3R_ViTLarge_BaseDecoder_512_catmlpdpt_metric", CC_BY_NC_SA),),
        ("mast3r", "dust3r"),
        "git clone --recursive https://github.com/naver/mast3r, and its folder on PYTHONPATH",
        about="pairs of pictures, brought into chunks here",
    ),
    ModelCard(
        "cut3r",
        "geometry",
        CC_BY_NC_SA,
        (),
        ("dust3r", "accelerate"),
        "git clone https://github.com/CUT3R/CUT3R, its folder src on PYTHONPATH, pip install accelerate einops",
        about="one picture after another; its dust3r is not that of DUSt3R",
    ),
    ModelCard(
        "ttt3r",
        "geometry",
        CC_BY_NC_SA,
        (),
        ("dust3r", "accelerate"),
        "git clone https://github.com/Inception3D/TTT3R, its folder src on PYTHONPATH, pip install accelerate einops",
        about="cut3r, which forgets less; takes the weights of cut3r",
    ),
    ModelCard(
        "fast3r",
        "geometry",
        FAIR_NC,
        (Weights("jedyang97/Fast3R_ViT_Large_512", FAIR_NC),),
        ("fast3r",),
        f"{_GIT}/facebookresearch/fast3r",
        about="all pictures at once, points without poses",
    ),
    _hub(
        "eomt", "discovery", Weights("tue-mps/coco_panoptic_eomt_large_640", MIT), "masks, query embeddings and labels"
    ),
    _hub(
        "mask2former", "discovery", Weights("facebook/mask2former-swin-tiny-coco-panoptic", OTHER), "masks and labels"
    ),
    _hub(
        "sam2", "discovery", Weights("facebook/sam2.1-hiera-tiny", APACHE, revision=SAM2_COMMIT), "masks of everything"
    ),
    _hub(
        "sam3",
        "discovery",
        Weights("facebook/sam3", SAM_LICENCE, gated=True, revision=SAM3_COMMIT),
        "masks of everything",
    ),
    _hub("sam2", "tracking", Weights("facebook/sam2.1-hiera-tiny", APACHE, revision=SAM2_COMMIT), "video tracker"),
    _hub("sam3", "tracking", Weights("facebook/sam3", SAM_LICENCE, gated=True, revision=SAM3_COMMIT), "video tracker"),
    _hub("edgetam", "tracking", Weights("yonigozlan/EdgeTAM-hf", APACHE), "small video tracker", also=("timm",)),
    _hub(
        "dinov2",
        "features",
        Weights("facebook/dinov2-small", APACHE, revision="150c8e7bb7cef2d30ec31b13a517af14840ee3f7"),
        "appearance",
    ),
    _hub(
        "dinov3",
        "features",
        Weights("facebook/dinov3-vits16-pretrain-lvd1689m", DINOV3_LICENCE, gated=True),
        "appearance",
    ),
    _hub(
        "siglip2",
        "text",
        Weights("google/siglip2-base-patch16-224", APACHE, revision="75de2d55ec2d0b4efc50b3e9ad70dba96a7b2fa2"),
        "free words in find and nearest",
    ),
    _hub(
        "clip",
        "text",
        Weights("openai/clip-vit-base-patch32", MIT, revision="3d74acf9a28c67741b2f4f2ea7635f0aaf6f0268"),
        "free words in find and nearest",
    ),
    _hub("owlv2", "detector", Weights("google/owlv2-base-patch16-ensemble", APACHE), "labels of all our nouns"),
    ModelCard("nanodet", "detector", APACHE, (), ("ncnn",), "pip install ncnn", about="labels of 80 kinds of objects"),
    ModelCard("aliked", "local features", BSD3, (), ("torch",), "pip install torch", about="learned local features"),
)
"""Every model that has an adapter here. Weights that a card does not name are the user's own (`--weights`)."""


def find_card(name: str, part: str) -> ModelCard | None:
    """Return the card of a model, None for one whose weights nobody fetches (rgbd, sfm, learned, ...)."""
    return next((c for c in CARDS if c.name == name and c.part == part), None)


def cards_named(name: str) -> list[ModelCard]:
    """All cards of a name: one network can serve several parts. Raises `OptionError` for a name that has none."""
    found = [c for c in CARDS if c.name == name]
    if not found:
        raise OptionError(f"{name} is not a known model; choose one of {', '.join(sorted({c.name for c in CARDS}))}")
    return found


def find_weights(card: ModelCard, repository: str) -> Weights | None:
    """Return the card's entry for a repository of weights, None for one that the card does not name."""
    return next((w for w in card.weights if w.repository.lower() == repository.lower()), None)
