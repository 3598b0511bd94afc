"""The records that cross the borders of the memory. Plain, frozen, and nothing in them knows of SQLite."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from html import escape
from typing import Annotated, Any, SupportsInt, cast

import numpy as np
from numpy.typing import NDArray

from list3r.memory.core.geometry import OrientedBox, Sim3


class JsonFields:
    """A dataclass that a command reports."""

    def as_dict(self) -> dict[str, Any]:
        """Return its fields for JSON."""
        return asdict(cast(Any, self))


@dataclass(frozen=True)
class Shape:
    """A note on an array's type hint: its lengths, -1 for one that is open."""

    sizes: tuple[int, ...]


Covariance = Annotated[NDArray[np.float64], Shape((7, 7))]
Pose = Annotated[NDArray[np.float64], Shape((4, 4))]
Plane = Annotated[NDArray[np.float64], Shape((4,))]
Feature = Annotated[NDArray[np.float32], Shape((-1,))]

# ---------------------------------------------------------------------------------------------- one chunk


@dataclass(frozen=True)
class Support:
    """Surface points of an instance."""

    points: NDArray[np.float32]
    """Chunk coordinates (or world, where said). Shape (N, 3)."""
    confidence: NDArray[np.float32]
    """In [0, 1]. Shape (N,)."""
    rgb: NDArray[np.uint8]
    """Colour. Shape (N, 3)."""


@dataclass(frozen=True)
class MaskTrack:
    """Where a local instance is seen, V frames."""

    frames: NDArray[np.int64]
    """Frame.index of the visible frames, ascending (the paper's V). Shape (V,)."""
    boxes_xyxy: NDArray[np.float32]
    """Bounding boxes, px. Shape (V, 4)."""
    centers_xy: NDArray[np.float32]
    """Centroids of the masks, px (the paper's P). Shape (V, 2)."""
    areas_px: NDArray[np.int32]
    """Mask areas. Shape (V,)."""
    visible_fraction: NDArray[np.float32]
    """Share of the instance's support inside the frame that nothing hides, in [0, 1]. Shape (V,)."""
    masks: tuple[NDArray[np.uint32], ...]
    """Run-length codes at the colour image's size (the paper's M), see `memory.core.masks`; one for each frame."""
    image_size: tuple[int, int]
    """(height, width) of the masks, px."""


@dataclass(frozen=True)
class MotionTrack:
    """Where a moving thing was over time."""

    frames: NDArray[np.int64]
    """Frame.index, ascending. Shape (V,)."""
    positions: NDArray[np.float32]
    """Middle of what was seen of it, chunk coordinates. Shape (V, 3)."""


@dataclass(frozen=True)
class LocalInstance:
    """One thing followed through one chunk (paper 3.1: a, M, V, P, z, and its geometric evidence)."""

    local_id: int
    """Unique within the chunk, from 0."""
    track: MaskTrack
    feature: Feature
    """Unit-length mean of the candidates' features (the paper's z). Shape (D,)."""
    support: Support
    """Chunk coordinates."""
    stability: float
    """Mean agreement of the propagated masks with the images, times the probability that it is one thing and all of it
    where the discoverer tells it, in [0, 1]."""
    plane: Plane | None = None
    """Plane (n, d), n . p + d = 0 in chunk coordinates, n towards the cameras, if it is flat. Shape (4,)."""
    structure: bool = False
    """True for a large flat surface that bounds the room rather than standing in it, as far as the chunk can tell."""
    dynamic: bool = False
    """True when it was seen to move against the rest."""
    motion: MotionTrack | None = None
    """Where it was while it moved, for dynamic ones."""
    names: tuple[tuple[str, float], ...] = ()
    """What the discoverer called it on each anchor, with its score in (0, 1); empty where it has no names."""
    named: tuple[tuple[str, float], ...] = ()
    """Names that it may have, with their probabilities over all views of the chunk, where the discoverer knows."""


@dataclass(frozen=True)
class LocalLibrary:
    """The local instance library of one chunk."""

    instances: tuple[LocalInstance, ...]
    cannot_link: NDArray[np.int32]
    """Pairs of local ids seen side by side in one frame with disjoint masks: two things, not one. Shape (P, 2)."""
    feature_space: str
    """Name of the embedding space of the features, `model@revision/dim`."""
    scraps: tuple[LocalInstance, ...] = ()
    """What is too unlikely to be one whole thing to be listed; `stability` is that probability. Seen in anchors alone,
    without part in anything that is derived from the instances."""


@dataclass(frozen=True)
class Keyframe:
    """What a chunk remembers of one frame so that a later one can be placed against it.

    A frame that is kept for its picture alone has zeros as descriptor, no features and no depth.
    """

    frame_index: int
    T_chunk_cam: NDArray[np.float64]
    """Pose of the colour camera. Shape (4, 4)."""
    descriptor: Feature
    """Unit-length descriptor of the whole frame. Shape (D,)."""
    keypoints_xy: NDArray[np.float32]
    """Local features, px. Shape (N, 2)."""
    keypoint_descriptors: NDArray[np.uint8]
    """Their descriptors. Shape (N, B)."""
    points_cam: NDArray[np.float32]
    """The features in camera coordinates, chunk units, NaN where depth is unknown. Shape (N, 3)."""
    depth_small: NDArray[np.float32]
    """Depth along z for dense checks, chunk units, 0 where unknown. Shape (h, w)."""
    camera_small: tuple[float, float, float, float]
    """fx, fy, cx, cy of `depth_small`, px."""
    jpeg: bytes = b""
    """The colour image, empty where keyframe pictures are not kept."""


@dataclass(frozen=True)
class FrameSamples:
    """Points of a chunk's frames on fixed pixel grids, the same in every chunk: what alignment works on.

    The same pixel of the same frame is the same surface point in two chunks that share the frame.
    """

    frame: NDArray[np.int64]
    """Frame.index of each sample. Shape (S,)."""
    pixel: NDArray[np.int32]
    """Row-major number of the sample's pixel in the colour image. Shape (S,)."""
    points: NDArray[np.float32]
    """Chunk coordinates. Shape (S, 3)."""
    confidence: NDArray[np.float32]
    """In [0, 1]. Shape (S,)."""
    instance: NDArray[np.int32]
    """Local id of the instance whose mask holds the pixel, -1 for none. Shape (S,)."""
    camera_frames: NDArray[np.int64]
    """Frame.index of the posed frames, ascending. Shape (G,)."""
    T_chunk_cam: NDArray[np.float64]
    """Poses of those frames' cameras. Shape (G, 4, 4)."""

    @staticmethod
    def empty() -> FrameSamples:
        """Return no samples at all."""
        return FrameSamples(
            frame=np.zeros(0, np.int64),
            pixel=np.zeros(0, np.int32),
            points=np.zeros((0, 3), np.float32),
            confidence=np.zeros(0, np.float32),
            instance=np.zeros(0, np.int32),
            camera_frames=np.zeros(0, np.int64),
            T_chunk_cam=np.zeros((0, 4, 4)),
        )


@dataclass(frozen=True)
class JointWindow:
    """Frames of two places reconstructed together once more (a loop pair shares no frame): u -> window -> v."""

    u: FrameSamples
    """The frames of chunk u, window coordinates; `instance` is -1 throughout."""
    v: FrameSamples
    """The frames of chunk v, the same window coordinates."""
    scale_kind: str
    """metric or relative."""


@dataclass(frozen=True)
class ChunkResult:
    """All that one chunk hands to association and the store."""

    index: int
    """Number of the chunk in its session, from 0."""
    frame_indices: NDArray[np.int64]
    """Frame.index of each decoded frame. Shape (F,)."""
    times_s: NDArray[np.float64]
    """Seconds. Shape (F,)."""
    posed: NDArray[np.bool_]
    """Shape (F,)."""
    T_chunk_cam: NDArray[np.float64]
    """Shape (F, 4, 4)."""
    T_source_cam: NDArray[np.float64] | None
    """Given poses of the source, NaN where a frame has none. Shape (F, 4, 4)."""
    intrinsics: tuple[float, float, float, float]
    """fx, fy, cx, cy, px."""
    image_size: tuple[int, int]
    """(height, width), px."""
    scale_kind: str
    keyframes: tuple[Keyframe, ...]
    samples: FrameSamples
    library: LocalLibrary
    bad_frames: tuple[tuple[int, str], ...] = ()
    """(Frame.index, reason) of frames that could not be decoded."""
    seconds: dict[str, float] = field(default_factory=dict)
    """CPU seconds by stage."""
    lost_reason: str = ""
    """Why the camera could not be followed through any of the frames, one sentence; empty where it could."""
    unsure: frozenset[int] = frozenset()
    """Frame.index of frames whose pose little supports."""


# ---------------------------------------------------------------------------------------------- the memory


@dataclass(frozen=True)
class SessionCamera:
    """The camera of a session whose source does not say all of it, as it was estimated."""

    intrinsics: tuple[float, float, float, float]
    """fx, fy, cx, cy of pictures as stored, px."""
    distortion: tuple[float, ...]
    """OpenCV's coefficients."""
    notes: tuple[str, ...] = ()
    """What the user should know of it, one sentence each."""


@dataclass(frozen=True)
class Session:
    """One video that was added to the memory."""

    session_id: int
    source: str
    fingerprint: str
    settings: dict[str, object]
    frame_count: int
    state: str
    """building, complete."""
    camera: SessionCamera | None = None
    """As it was estimated; None where the source says it or nobody looked yet."""
    cuts: tuple[int, ...] | None = None
    """Positions before which the video jumps; None before anybody looked."""
    depth_step: int | None = None
    """From every how many frames depth is computed; None where that was not settled."""
    lost_reasons: tuple[str, ...] = ()
    """Why the camera could not be followed through chunks, one sentence each."""


@dataclass(frozen=True)
class ChunkRow:
    """One chunk as the memory keeps it."""

    chunk_id: int
    session_id: int
    index: int
    first_frame: int
    last_frame: int
    component: int
    """Chunks of one component share one frame of reference; the smallest chunk id names it."""
    S_world_chunk: Sim3
    intrinsics: tuple[float, float, float, float]
    image_size: tuple[int, int]
    scale_kind: str
    covariance: Covariance | None = None
    """Of the tangent error x in S_true = S_world_chunk exp(x), x = (rho, omega, sigma), relative to the first chunk of
    the component; None where it is not known. Shape (7, 7)."""


@dataclass(frozen=True)
class Edge:
    """A measured relation of two chunks."""

    u: int
    """Chunk id."""
    v: int
    """Chunk id."""
    kind: str
    """adjacent, loop, or prior (by poses that the source gives)."""
    S_v_u: Sim3
    confidence: float
    """m_uv of the paper (A.4), in [0, 1]."""
    weight: float
    """Weight in the graph, in [0, 1], the strongest edge 1."""
    inliers: int
    residual_m: float
    """RMS of the inliers' residuals, chunk units."""
    accepted: bool
    reason: str
    """Why it was accepted or rejected, one sentence."""
    scores: dict[str, float] = field(default_factory=dict)
    frames: tuple[int, int] | None = None
    """Frame.index in u and in v of the pair that proposed a loop."""
    covariance: Covariance | None = None
    """Of the tangent error x in S_true = S_v_u exp(x), x = (rho, omega, sigma) in u's units; None where it is not
    known. Shape (7, 7)."""

    @property
    def by_things(self) -> bool:
        """True where things alone gave the relation, not frames."""
        return "things_pairs" in self.scores


UNSURE = "little supports the pose"


@dataclass(frozen=True)
class FrameRow:
    """One frame of the trajectory."""

    session_id: int
    frame_index: int
    time_s: float
    chunk_id: int
    """The chunk whose geometry places it."""
    state: str
    """posed, lost (could not be followed), bad (could not be decoded)."""
    T_chunk_cam: Pose
    """Shape (4, 4), NaN unless posed."""
    note: str = ""
    """Why it could not be decoded; of a posed one `UNSURE` where little supports the pose."""


@dataclass(frozen=True)
class BestView:
    """The frame in which an instance is seen best."""

    session_id: int
    frame_index: int
    box_xyxy: tuple[float, float, float, float]
    """px."""


FIRST_SCRAP = 1_000_000_000
"""From this on ids are those of scraps, see `maintenance.unlisted`."""
FIRST_UNLISTED = 1_500_000_000
"""From this on ids are those of groups that are not listed, see `maintenance.unlisted`."""


@dataclass(frozen=True)
class Instance:
    """One physical thing of the world (paper 3.3)."""

    id: int
    label: str | None
    description: str
    """Words from colour, size and shape: "small white cylinder, 9 cm"."""
    center: NDArray[np.float64]
    """Centre of the box, world. Shape (3,)."""
    aabb: NDArray[np.float64]
    """Lower and upper corner, world. Shape (2, 3)."""
    box: OrientedBox
    """Upright where gravity is known."""
    confidence: float
    """In [0, 1]: grows with the number of frames and chunks that agree."""
    observations: int
    """Frames in which it is seen."""
    first_seen_s: float
    last_seen_s: float
    state: str
    """present, moved, removed, added, unseen."""
    structure: str | None
    """floor, ceiling, wall or plane for what bounds the room, else None."""
    color_rgb: tuple[int, int, int]
    """Median colour."""
    color_name: str
    component: int
    """The frame of reference it lives in, see `ChunkRow`."""
    best_view: BestView | None
    dynamic: bool = False
    """True for what was seen moving; its box is where it was seen last."""
    position_sigma_m: float | None = None
    """Standard deviation of its position from the uncertainty of its chunks, world units, along the worst axis; None
    where it is not known."""

    @property
    def name(self) -> str:
        """Its label, else the kind of structure, else its description."""
        return self.label or self.structure or self.description

    def __repr__(self) -> str:
        x, y, z = self.center
        return f"<Instance {self.id}: {self.name} at ({x:.2f}, {y:.2f}, {z:.2f}), confidence {self.confidence:.2f}>"

    def _repr_html_(self) -> str:
        rows = {
            "id": str(self.id),
            "name": self.name,
            "description": self.description,
            "centre": ", ".join(f"{v:.2f}" for v in self.center),
            "size": " x ".join(f"{v:.2f}" for v in self.box.size),
            "confidence": f"{self.confidence:.2f}",
            "state": self.state,
        }
        return f"<table>{''.join(f'<tr><th>{k}</th><td>{escape(v)}</td></tr>' for k, v in rows.items())}</table>"


def id_of(what: SupportsInt | Instance) -> int:
    """Return the id of an instance, or the id itself."""
    return what.id if isinstance(what, Instance) else int(what)


@dataclass(frozen=True)
class Observation:
    """One local instance that belongs to a global one."""

    instance_id: int
    chunk_id: int
    local_id: int


@dataclass(frozen=True)
class Relation:
    """subject predicate object, with how sure and how near to the decision it is."""

    subject: int
    predicate: str
    object: int
    confidence: float
    """In [0, 1]."""
    margin: float
    """Distance to the decision boundary, world units."""


@dataclass(frozen=True)
class Room:
    """A space between walls, seen from above."""

    id: int
    floor: int
    """Its storey, from 0 for the lowest."""
    floor_z: float
    """Height of the floor, world."""
    outline: NDArray[np.float64]
    """World x and y of its corners, counterclockwise. Shape (N, 2)."""
    area: float
    """Square units of the world."""
    partial: str
    """Why it may be larger or end elsewhere; empty for a room that was seen whole."""
    instances: tuple[int, ...] = ()
    """Ids of what is in it, without its structure."""
    name: str | None = None
    """What it is called; None where nothing in it says so."""
    reason: str = ""
    """What it has its name from."""


@dataclass(frozen=True)
class Doorway:
    """An opening between two rooms."""

    a: int
    b: int
    """Ids of the rooms; a < b."""
    position: NDArray[np.float64]
    """Its middle, on the floor, world. Shape (3,)."""
    width: float
    """World units."""


@dataclass(frozen=True)
class ChangeEvent:
    """What a session showed of a thing that was known before, or of a new one where nothing stood before."""

    session_id: int
    instance_id: int
    kind: str
    """seen_again, moved, removed, added."""
    from_box: OrientedBox | None
    """Where it was before the session, world; None for what was added."""
    to_box: OrientedBox | None
    """Where the session saw it, world; None for what was removed."""
    frames: tuple[tuple[int, int], ...]
    """(session id, Frame.index) of the evidence, the most telling first."""
    confidence: float
    """In [0, 1]."""
    reason: str
    """Why, one sentence."""


@dataclass(frozen=True)
class Votes:
    """What was seen of a local instance, or of several together."""

    missed: float
    """Log odds that every class loses for all frames that looked; a class has them back for those that found it."""
    classes: Mapping[str, tuple[float, float]]
    """By class: in how many pictures it was found (weighted), and the log odds that they add up to."""
    looks: float = 0.0
    """In how many pictures it was looked at (weighted); 0 where nobody counted."""

    def __add__(self, other: Votes) -> Votes:
        zero, classes = (0.0, 0.0), {}
        for name in sorted({*self.classes, *other.classes}):
            (a, b), (c, d) = self.classes.get(name, zero), other.classes.get(name, zero)
            classes[name] = (a + c, b + d)
        return Votes(self.missed + other.missed, classes, self.looks + other.looks)


@dataclass(frozen=True)
class DetectedLabel:
    """A label and where it comes from."""

    label: str
    confidence: float
    """Probability of the class, in [0, 1]."""
    found: float
    """Independent pictures in which it was found, weighted."""
    detector: str
    """Who found it, by name, with commas between several."""
    level: str = "leaf"
    """leaf: the name of a thing; branch: only a kind of things ("seat"), where no name in it is sure enough."""


@dataclass(frozen=True)
class UpEstimate:
    """Which way is up, in the frame of the pose graph."""

    up: NDArray[np.float64]
    """Unit vector. Shape (3,)."""
    floor_height: float | None
    """Of the floor along it; None where none was seen."""


@dataclass(frozen=True)
class MergeDecision:
    """One entry of the log: why two things became one, or did not."""

    kind: str
    """merge, refuse, alias, split."""
    a: str
    """What was joined: `chunk_id:local_id` for a local instance, `#id` for a global one."""
    b: str
    scores: dict[str, float]
    reason: str
