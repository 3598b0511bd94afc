"""All that decides what a build or an update makes of a video, one field for each stage."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import Any

from list3r.association.graph.chunk_nodes import NodeSettings
from list3r.association.graph.edge_information import WeightSettings
from list3r.association.graph.pose_graph import GraphSettings
from list3r.association.graph.surface_graph import SurfaceSettings
from list3r.association.overlap.camera_edge import CameraEdgeSettings
from list3r.association.overlap.motion import MotionSettings
from list3r.association.overlap.overlap_edge import EdgeSettings
from list3r.association.overlap.prior_edge import PriorEdgeSettings
from list3r.association.revisits.reprojection_edge import ReprojectionSettings
from list3r.association.revisits.search import RevisitSettings
from list3r.association.revisits.session_edges import SessionEdgeSettings
from list3r.association.whole_map.settings import VideoMapSettings
from list3r.frames.chunking.borrowing import BorrowSettings
from list3r.frames.chunking.chunks import ChunkSettings
from list3r.frames.chunking.cuts import ShotCutSettings
from list3r.frames.chunking.pace import PaceSettings
from list3r.instances.carving.carved_surfaces import ChangedPlaceSettings
from list3r.instances.settings import InstanceSettings
from list3r.memory.core.errors import MemoryFileError, OptionError
from list3r.memory.core.records import Session
from list3r.memory.core.settings import as_plain, from_plain
from list3r.memory.library.rules import ConsolidationSettings
from list3r.reconstruction.settings import ReconstructionSettings

ASSOCIATIONS = ("list3r", "paper", "frames")


@dataclass(frozen=True)
class AssociationSettings:
    """How chunks become one world."""

    revisits: RevisitSettings = field(default_factory=RevisitSettings)
    edges: EdgeSettings = field(default_factory=EdgeSettings)
    cameras: CameraEdgeSettings = field(default_factory=CameraEdgeSettings)
    """Of edges by the cameras of two chunks, where a model knows those better than surfaces."""
    prior: PriorEdgeSettings = field(default_factory=PriorEdgeSettings)
    """Of edges by poses that the source gives as a prior."""
    reprojection: ReprojectionSettings = field(default_factory=ReprojectionSettings)
    """Of loops of such models."""
    ties: SessionEdgeSettings = field(default_factory=SessionEdgeSettings)
    graph: GraphSettings = field(default_factory=GraphSettings)
    nodes: NodeSettings = field(default_factory=NodeSettings)
    surfaces: SurfaceSettings = field(default_factory=SurfaceSettings)
    solved_whole: int = 60
    """Chunks up to which every new one solves the whole graph again (some milliseconds); beyond, it is fitted in."""
    up_always: int = 64
    """Chunks up to which every new one makes it be asked which way is up and what a unit of the world is. Beyond, that
    stands until the session is finished: to turn the world is to touch all of it."""
    up_again: int = 32
    """Where up is not known yet it is asked again after so many chunks."""
    guess_metre: bool = True
    """Where nobody knows lengths, a metre is guessed at the end of a session."""

    @classmethod
    def by_method(cls, method: str) -> AssociationSettings:
        """Return ours ("list3r"), the paper's steps as it writes them ("paper"), or frames alone with VGGT-Long's
        threshold, alignment and equal weights ("frames").

        Raises `OptionError`.
        """
        ours = cls()
        if method == "list3r":
            return ours
        if method not in ASSOCIATIONS:
            raise OptionError(f"--association {method}: choose from {', '.join(ASSOCIATIONS)}")
        paper = method == "paper"
        edges = replace(ours.edges, method="paper" if paper else "plain")
        loops = replace(ours.revisits, rule="score", window=replace(ours.revisits.window, edges=edges))
        return replace(
            ours,
            revisits=loops if paper else replace(loops, lambda_=1.0, least_score=0.85),
            edges=edges,
            graph=replace(ours.graph, robust=False, weights=WeightSettings(rule="confidence" if paper else "equal")),
            nodes=replace(ours.nodes, enabled=False),
        )


@dataclass(frozen=True)
class BuildSettings:
    """What shapes a memory. Two builds of one source with equal settings give equal memories.

    The settings are stored with the session. `--resume` goes on with them, and an update without settings of its own
    takes those of the memory's stages.
    """

    reconstruction: str = "auto"
    """The reconstruction model; auto: rgbd where the source has depth, else sfm."""
    poses: str = "estimate"
    """given, prior (given, but corrected), estimate, or auto: given where the source has them,
    prior where they drift (phones) and the model can correct them."""
    up: str = "planes"
    """Who says which way is up: planes (level surfaces, or the camera where they do not decide), source (given poses
    of a recorder that knows gravity), camera (as it was held), unknown, or the user: x,y,z, see `BuildRequest.up`."""
    device: str = "auto"
    """Where neural models run: cpu, cuda, or auto, the first GPU where there is one."""
    weights: str | None = None
    """Weights of the reconstruction model instead of its own."""
    discovery: str = "learned"
    """What finds things on anchor frames."""
    tracking: str = "reprojection"
    """What follows them through the chunk."""
    features: str = "geometric"
    """What describes the look of a thing, by which it is recognised."""
    instance_weights: tuple[tuple[str, str], ...] = ()
    """Weights of the three, (part/model, a path or repository@commit), such as ("discovery/eomt", ...)."""
    frame_look: str = "local"
    """What describes whole keyframes, by which places are found again: local (their SIFT features), or network (that of
    `features`, where it is one). That of the first session holds for a memory: only alike descriptors compare."""
    local_features: str = "sift"
    """What finds a keyframe again: sift or aliked; aliked also ties frames of `sfm` between which nothing can be
    followed."""
    feature_weights: str | None = None
    """File of the weights of learned local features."""
    chunks: ChunkSettings = field(default_factory=ChunkSettings)
    """By frames that get depth."""
    depth_every: int | None = None
    """From every how many frames models that compute depth do so, the others get a pose; None: by `pace`."""
    instances: InstanceSettings = field(default_factory=InstanceSettings)
    keep_pictures: bool = True
    """Keep a JPEG of each keyframe in the memory."""
    cuts: ShotCutSettings = field(default_factory=ShotCutSettings)
    """Where the video jumps."""
    pace: PaceSettings = field(default_factory=PaceSettings)
    video_map: VideoMapSettings = field(default_factory=VideoMapSettings)
    """One map of the whole video before its chunks, where its steps are wide."""
    borrowing: BorrowSettings = field(default_factory=BorrowSettings)
    """Frames from around a chunk through which the camera hardly moves."""
    models: ReconstructionSettings = field(default_factory=ReconstructionSettings)
    """Of every reconstruction model and its estimate of an unknown camera, and what a chunk keeps of its frames."""
    motion: MotionSettings = field(default_factory=MotionSettings)
    """What has moved inside a chunk."""
    association: AssociationSettings = field(default_factory=AssociationSettings)
    carving: ChangedPlaceSettings = field(default_factory=ChangedPlaceSettings)
    """Surfaces that another session sees through."""
    library: ConsolidationSettings = field(default_factory=ConsolidationSettings)
    """How the library is derived from the chunks. Those of the first session hold for a memory."""

    def as_plain(self) -> dict[str, Any]:
        """Return them for JSON."""
        return as_plain(self)

    def differing(self, other: BuildSettings) -> list[str]:
        """Return the names of the fields in which two settings differ."""
        return [f.name for f in fields(self) if getattr(self, f.name) != getattr(other, f.name)]


def session_settings(session: Session) -> BuildSettings:
    """Return the settings that a session was made with; what an older version did not store has its default.

    Raises `MemoryFileError`.
    """
    try:
        return from_plain(BuildSettings, session.settings)
    except (ValueError, TypeError) as error:
        raise MemoryFileError(f"the settings of session {session.session_id} cannot be read: {error}") from error
