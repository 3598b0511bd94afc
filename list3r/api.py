"""The Python interface of a memory: open, build, ask, edit, export.

The module of a question is imported when it is asked, so that simple questions start fast.
"""

from __future__ import annotations

import functools
import html
import io
import tempfile
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Concatenate, ParamSpec, Self, TypeVar, Unpack, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from list3r.memory.core.errors import List3rError, OptionError, UnknownIdError, check_share, naming_extras
from list3r.memory.core.records import Instance, id_of
from list3r.memory.library.maintenance.editing import MemoryEdits
from list3r.memory.library.world.scale import Lengths, lengths_of
from list3r.memory.store.store import Store
from list3r.queries.answers import Answers, Rows

if TYPE_CHECKING:
    import networkx
    import open3d
    import pandas
    import trimesh
    from matplotlib.figure import Figure

    from list3r.exporters.prompt.scene_text import ScenePrompt
    from list3r.exporters.registry import ExportOptions
    from list3r.exporters.tables import Table
    from list3r.frames.options import SourceOptions
    from list3r.memory.core.geometry import Sim3
    from list3r.memory.core.records import Doorway, FrameRow, Relation, Room, Session, Support
    from list3r.pipeline.request import BuildRequest, RunArguments
    from list3r.pipeline.settings import BuildSettings
    from list3r.queries.changes import Changed
    from list3r.queries.find import Found
    from list3r.queries.finding.free_words import WordEncoder
    from list3r.queries.match import FilterOptions, Match, Matches
    from list3r.queries.measure import InstanceDistance
    from list3r.queries.pictures import InstancePicture, KeyframePicture
    from list3r.queries.relations import Place, Relations
    from list3r.queries.rooms import RoomPath
    from list3r.queries.seen import Sightings
    from list3r.queries.views.camera import PosedCamera
    from list3r.queries.views.fused import Surface


P = ParamSpec("P")
R = TypeVar("R")


def _alone(method: Callable[Concatenate[SceneMemory, P], R]) -> Callable[Concatenate[SceneMemory, P], R]:
    """Let one thread in at a time: all threads share the file's connection and its caches."""

    @functools.wraps(method)
    def guarded(self: SceneMemory, /, *args: P.args, **kwargs: P.kwargs) -> R:
        # An answer must see one state while another process writes; a writer has none beside it.
        with naming_extras(), self._lock, nullcontext() if self.store.writable else self.store.snapshot():
            answer = method(self, *args, **kwargs)
            if isinstance(answer, Rows):
                answer.picture_of = self._thumbnail
            return answer

    return guarded


def open(
    path: str | Path, *, writable: bool = False, at: int | None = None, min_confidence: float | None = None
) -> SceneMemory:
    """Open a memory for reading, or with `writable` also for editing. Raises `MemoryFileError` for other files.

    Many can read while one writes; a second writer is refused. With `at` every question is about the world as it was
    after that session, and nothing can be written. Raises `OptionError` for an unknown session.

    With `min_confidence` every question is about all instances with at least that confidence, low-confidence segments
    too, which are otherwise not listed. Nothing can be written then, and with `at` there are none of these.

    >>> list3r.open("house.l3r", at=1).nearest((0.5, 1.2, 0.8))
    >>> list3r.open("house.l3r", min_confidence=0.2).instances()
    """
    if min_confidence is not None:
        check_share("min_confidence", min_confidence)
    if at is None and min_confidence is None:
        return SceneMemory(Store.open(path, writable=writable))
    if writable:
        which = "with what it does not list" if at is None else f"as it was after session {at}"
        raise OptionError(f"{path} {which} can only be read")
    with Store.open(path) as store:
        if at is not None:
            from list3r.memory.library.maintenance.as_of import store_at

            return SceneMemory(store_at(store, at))
        from list3r.memory.library.maintenance.unlisted import store_with_unlisted

        return SceneMemory(store_with_unlisted(store, min_confidence or 0.0))


@naming_extras()
def build(
    source: str | Path,
    memory: str | Path,
    *,
    options: SourceOptions | None = None,
    settings: BuildSettings | BuildRequest | None = None,
    **run: Unpack[RunArguments],
) -> SceneMemory:
    """Build the memory of a video or folder, or of a webcam or stream until it ends, and open it.

    `options` describes the source (intrinsics, depth scale, ...). `settings` says how it is processed: a `BuildRequest`
    names models or a preset and leaves the rest to the machine, `BuildSettings` decides everything.

    Further arguments: `workers`, the number of processes; `engine`, "ray" for a cluster at an `address`; `resume`
    continues a build that was interrupted; `force` replaces an existing memory. `licence` names the
    licences that networks may have: permissive (any use, no account), research (also non-commercial, gated and custom
    ones) or any. `scale_anchor` is a known length, `detector` (with `detector_classes`) the file of a box detector.
    Raises `SourceError`, `OptionError`, `MemoryFileError` or `TrackingError`; the message says how to fix it.

        >>> list3r.build("walk/", "house.l3r", settings=list3r.BuildRequest(preset="light"), workers=2)
    """
    from list3r.pipeline.live import build_any
    from list3r.pipeline.request import RunOptions

    build_any(source, memory, options=options, settings=settings, run=RunOptions(**run))
    return open(memory)


def update(
    memory: str | Path,
    source: str | Path,
    *,
    options: SourceOptions | None = None,
    settings: BuildSettings | BuildRequest | None = None,
    **run: Unpack[RunArguments],
) -> SceneMemory:
    """Add a later video to a memory and open it; `SceneMemory.changes` then lists what was moved, removed and added.

    The arguments are those of `build`; `force` gives up an update that was interrupted. A video in which no stored
    place is recognised becomes a connected component of its own. Raises `SourceError`, `OptionError`,
    `TrackingError` or `MemoryFileError`; the message says how to fix it.
    """
    from list3r.pipeline import update as updating
    from list3r.pipeline.request import RunOptions

    updating.update(memory, source, options=options, settings=settings, run=RunOptions(**run))
    return open(memory)


class SceneMemory(MemoryEdits):
    """An open memory. Use it as a context manager, or call `close`.

    No question writes to the file. Several threads can share a `SceneMemory`; their questions take turns. To ask in
    parallel open the file once in each thread or process. A writer does not disturb readers.
    """

    def __init__(self, store: Store) -> None:
        self.store = store
        self._lock = threading.RLock()

    def __repr__(self) -> str:
        from list3r.queries.info import describe_counts

        try:
            text = f"{self.path.name!r}: {describe_counts(self.store)}"
        except List3rError:
            text = f"{self.path.name!r}, closed"
        return f"<SceneMemory {text}>"

    def __len__(self) -> int:
        return len(self.instances())

    def __bool__(self) -> bool:
        return True  # also where it holds nothing yet

    def __iter__(self) -> Iterator[Instance]:
        return iter(self.instances())

    def __contains__(self, what: object) -> bool:
        if isinstance(what, str):
            return bool(self._named(what))
        return isinstance(what, int | np.integer | Instance) and any(
            i.id == id_of(what) for i in self.instances(structure=None)
        )

    @overload
    def __getitem__(self, what: int | Instance) -> Instance: ...

    @overload
    def __getitem__(self, what: str) -> Answers[Instance]: ...

    def __getitem__(self, what: int | str | Instance) -> Instance | Answers[Instance]:
        """Return the instance of an id, or by id all that carry a name, structure too (those that are gone as well).

        A name is compared with labels, kinds of structure and descriptions, as by the filter `label`. Raises
        `UnknownIdError`, a `KeyError`; for a name it tells close ones.

        >>> memory[12].name
        >>> memory["chair"].boxes
        """
        if isinstance(what, int | np.integer | Instance):
            return self.instance(what)
        if not isinstance(what, str):
            raise OptionError(f"memory[{what!r}]: give an id or a name; list(memory) is sliced")
        found = self._named(what)
        if not found:
            from difflib import get_close_matches

            names = sorted({i.name for i in self.instances(structure=None)})
            close = get_close_matches(what, names, 5, 0.5) or names[:5]
            told = f"; close names: {', '.join(close)}" if close else ""
            raise UnknownIdError(f"{self.path} has nothing called {what!r}{told}")
        return found

    @_alone
    def _named(self, name: str) -> Answers[Instance]:
        from list3r.queries.finding.words import is_named

        return Answers(i for i in self.store.instances.all() if is_named(i, name))

    def _thumbnail(self, instance_id: int) -> bytes | None:
        """Return a JPEG of the instance of at most 96 px, None where no stored picture shows it or the file is shut."""
        from PIL import Image

        try:
            image = Image.fromarray(self.picture(instance_id).crop())
        except List3rError:
            return None
        image.thumbnail((96, 96))
        out = io.BytesIO()
        image.save(out, "JPEG", quality=80)
        return out.getvalue()

    def _repr_html_(self) -> str:
        return f"<p>{html.escape(repr(self)[1:-1])}</p>{self.instances()._repr_html_()}"

    @property
    def boxes(self) -> NDArray[np.float64]:
        """Lower and upper corner of every thing, in the order of iteration, world. Shape (N, 2, 3).

        >>> memory.boxes[:, 1] - memory.boxes[:, 0]
        """
        return self.instances().boxes

    @property
    @_alone
    def points(self) -> NDArray[np.float32]:
        """Surface points of all things, one after the other, world; `support(12).points` are those of one. (P, 3).

        >>> memory.points.mean(axis=0)
        """
        surfaces = [self.store.surfaces.of(i.id).points for i in self.store.instances.all(structure=False)]
        return np.concatenate(surfaces) if surfaces else np.zeros((0, 3), np.float32)

    @_alone
    def to_dataframe(self, table: Table = "instances") -> pandas.DataFrame:
        """Return the table of instances (structure too), relations or frames.

        Columns are those of `list3r.exporters.tables.COLUMNS`. Raises `MissingPackageError` without pandas, and
        `OptionError` for another table.

        >>> memory.to_dataframe().set_index("id")
        """
        from list3r.exporters.tables import records_of
        from list3r.queries.answers import dataframe

        return dataframe(records_of(self.store, table))

    @_alone
    def to_open3d(self, *which: int | Instance, structure: bool | None = False) -> open3d.geometry.PointCloud:
        """Return the coloured points of some instances, by default of all things, as one cloud of open3d.

        >>> open3d.visualization.draw_geometries([memory.to_open3d()])
        """
        from list3r.exporters.clouds import open3d_cloud

        return open3d_cloud(self.store, self._chosen(which, structure))

    @_alone
    def to_trimesh(self, *which: int | Instance, structure: bool | None = False) -> trimesh.Scene:
        """Return some instances, by default all things, as a scene of trimesh: a point cloud each, called "ID NAME".

        >>> memory.to_trimesh(12).extents
        """
        from list3r.exporters.clouds import trimesh_scene

        return trimesh_scene(self.store, self._chosen(which, structure))

    def _chosen(self, which: Sequence[int | Instance], structure: bool | None) -> list[Instance]:
        return [self.instance(i) for i in which] or self.store.instances.all(structure=structure)

    @_alone
    def plot(self) -> Figure:
        """Return the plan of the largest component as a figure of matplotlib; its axes are the memory's x and y.

        >>> memory.plot().savefig("plan.pdf")
        """
        from list3r.exporters.components import read_components
        from list3r.exporters.plan.drawing import plan_figure

        return plan_figure(self.store, read_components(self.store)[0])

    @_alone
    def info(self) -> dict[str, Any]:
        """Return sessions, frames, scale, gravity and counts as plain values, like `list3r info --json`."""
        from list3r.queries.info import info

        return info(self.store)

    def _repr_png_(self) -> bytes:
        """Return the plan, for notebooks."""
        with tempfile.TemporaryDirectory() as folder:
            return self.export("plan", Path(folder) / "plan.png")[0].read_bytes()

    @property
    def path(self) -> Path:
        """The file."""
        return self.store.path

    @property
    def writable(self) -> bool:
        """Whether it is open for editing."""
        return self.store.writable

    @property
    def units(self) -> str:
        """`m` when lengths are metres, `unit` when nobody knows; one is about a metre where `lengths` says guessed."""
        return self.lengths.units

    @property
    def lengths(self) -> Lengths:
        """The unit of lengths, who knows it, and how surely."""
        with self._lock:
            return lengths_of(self.store)

    @property
    def gravity(self) -> str:
        """known, estimated by surfaces, assumed by how the camera was held (z is up in all three), or unknown."""
        with self._lock:
            return self.store.facts.gravity

    @_alone
    def instances(self, *, structure: bool | None = False) -> Answers[Instance]:
        """Return the things by id; with `structure=True` the structure of the room, with None both.

        >>> memory.instances().to_dataframe()
        """
        return Answers(self.store.instances.all(structure=structure))

    @_alone
    def changes(self, since: int | None = None, *, min_confidence: float = 0.0) -> Answers[Changed]:
        """Return what was moved, removed and added in the sessions after `since`, the newest session first."""
        from list3r.queries.changes import changes

        return Answers(changes(self.store, since, min_confidence=min_confidence))

    @_alone
    def instance(self, instance_id: int | Instance) -> Instance:
        """Return an instance by its id, or by any id it ever had. Raises `UnknownIdError`."""
        return self.store.instances.get(id_of(instance_id))

    @_alone
    def support(self, instance_id: int | Instance) -> Support:
        """Return the surface points of an instance, world coordinates."""
        return self.store.surfaces.of(id_of(instance_id))

    @_alone
    def footprint(self, instance_id: int | Instance) -> NDArray[np.float64]:
        """Return the outline of what an instance covers as seen from above, world x and y, counterclockwise: an
        L-shaped counter has six corners. Means something where `memory.gravity` is known. Shape (N, 2).

        >>> memory.footprint(12)
        """
        from list3r.queries.views.footprint import footprints_of

        return footprints_of(self.store, [self.instance(instance_id)])[0]

    @_alone
    def surfaces(self) -> dict[int, Surface]:
        """Return the surface of each present instance, by id, and under 0 what is of none, in world coordinates:
        coloured triangles fused from stored depth, open where nothing was seen. The most that there is to look at.

        Points without faces where the extra `surfaces` is not installed or no stored depth shows an instance. Fusing
        takes seconds the first time, and is kept in the user's cache.
        """
        from list3r.queries.views.dense import surfaces

        return surfaces(self.store)

    @_alone
    def track(self, instance_id: int | Instance) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the path of a `dynamic` instance: seconds (V,) and world positions (V, 3); V = 0 for others."""
        return self.store.tracks.of(id_of(instance_id))

    @_alone
    def nearest(
        self,
        target: str | int | Instance | ArrayLike,
        k: int = 5,
        *,
        max_distance: float | None = None,
        **filters: Unpack[FilterOptions],
    ) -> Matches:
        """Return the k things nearest to a point (x, y, z) or to an instance, or those that words name best.

        Distances are between surfaces and between centres. For the filters (`structure`, `min_confidence`, `state`,
        `label`, `color`, `min_size`, `max_size`, `component`, `dynamic`, `room`) see `list3r.queries.match.Filters`.

            >>> memory.nearest((0.5, 1.2, 0.8), k=3, color="red", max_distance=1.0)
        """
        from list3r.queries.nearest import nearest

        if isinstance(target, str):
            encoder = self.word_encoder()
            return nearest(self.store, words=target, k=k, max_distance=max_distance, encoder=encoder, **filters)
        if isinstance(target, int | np.integer | Instance):
            return nearest(self.store, instance_id=id_of(target), k=k, max_distance=max_distance, **filters)
        return nearest(self.store, point=target, k=k, max_distance=max_distance, **filters)

    @_alone
    def within(
        self,
        *,
        lower: ArrayLike | None = None,
        upper: ArrayLike | None = None,
        center: ArrayLike | None = None,
        radius: float | None = None,
        camera: PosedCamera | None = None,
        max_depth: float | None = None,
        occlusion: bool = True,
        **filters: Unpack[FilterOptions],
    ) -> Answers[Match]:
        """Return the things in a box (`lower`, `upper`), a sphere (`center`, `radius`) or the frustum of a `camera`.

        `memory.camera(...)` makes a camera. What other things hide from it is left out, unless `occlusion` is off.

            >>> memory.within(camera=memory.camera(frame=120), max_depth=3.0)
        """
        from list3r.queries.within import within

        return Answers(
            within(
                self.store,
                lower=lower,
                upper=upper,
                center=center,
                radius=radius,
                camera=camera,
                max_depth=max_depth,
                occlusion=occlusion,
                **filters,
            )
        )

    @_alone
    def similar(
        self,
        target: int | Instance | ArrayLike,
        k: int = 5,
        *,
        space: str | None = None,
        **filters: Unpack[FilterOptions],
    ) -> Answers[Match]:
        """Return the things that look most like an instance, or like a vector of a named embedding space."""
        from list3r.queries.similar import similar

        if isinstance(target, int | np.integer | Instance):
            return Answers(similar(self.store, instance_id=id_of(target), space=space, k=k, **filters))
        return Answers(similar(self.store, vector=target, space=space, k=k, **filters))

    @_alone
    def similar_to_picture(
        self,
        image: str | Path | NDArray[np.uint8],
        k: int = 5,
        *,
        box_xyxy: tuple[float, float, float, float] | None = None,
        **filters: Unpack[FilterOptions],
    ) -> Answers[Match]:
        """Return the things that look most like a picture (a file, or RGB of shape (H, W, 3)), or like a box of it.

        Compared by the model of `list3r embed`, or by colours alone if it was not run. The reason says which.

            >>> memory.similar_to_picture("mug.jpg", box_xyxy=(120, 80, 180, 150))
        """
        from list3r.queries.similar import similar
        from list3r.semantics.picture_query import picture_query

        asked = picture_query(self.store, image, box_xyxy)
        return Answers(similar(self.store, vector=asked.vector, space=asked.space, part=asked.part, k=k, **filters))

    @_alone
    def find(
        self, text: str, k: int = 5, *, viewpoint: Place | Instance | None = None, encoder: WordEncoder | None = None
    ) -> Found:
        """Return the things that a text describes, the best first. If nothing fits, `notes` say why.

        Words are matched with labels, descriptions, colours and sizes; an id can stand for a thing. Left, right, front
        and behind are as seen from `viewpoint`, or as in the picture that shows the other thing best. Words that
        describe no thing are compared by an `encoder` of an embedding space of the memory, by default the model of
        `list3r embed`.

            >>> memory.find("white mug on table")
            >>> memory.find("the biggest red thing near the door", k=1)
        """
        from list3r.queries.find import find

        seen_from = viewpoint.id if isinstance(viewpoint, Instance) else viewpoint
        return find(self.store, text, k, viewpoint=seen_from, encoder=encoder or self.word_encoder())

    def word_encoder(self) -> WordEncoder | None:
        """Return the model that compares free words, or None if the memory was not embedded by a text-image model."""
        from list3r.semantics.embedding import stored_text_model

        return stored_text_model(self.store)

    @_alone
    def seen(self, instance_id: int | Instance, *, gap_s: float = 1.0) -> Sightings:
        """Return when and in which frames an instance was seen. Gaps up to `gap_s` seconds do not end an interval."""
        from list3r.queries.seen import seen

        return seen(self.store, id_of(instance_id), gap_s=gap_s)

    @_alone
    def visible(
        self,
        camera: PosedCamera,
        *,
        min_visible: float = 0.1,
        max_depth: float | None = None,
        **filters: Unpack[FilterOptions],
    ) -> Answers[Match]:
        """Return what a camera sees: things of which at least a share of `min_visible` is not hidden by others.

        >>> memory.visible(memory.camera(time_s=12.5))
        """
        from list3r.queries.seen import visible

        return Answers(visible(self.store, camera, min_visible=min_visible, max_depth=max_depth, **filters))

    @_alone
    def camera(
        self,
        *,
        frame: int | None = None,
        time_s: float | None = None,
        position: ArrayLike | None = None,
        quat_wxyz: ArrayLike | None = None,
        session: int | None = None,
    ) -> PosedCamera:
        """Return the camera of a posed `frame`, of the posed frame nearest to `time_s`, or at a given pose.

        A pose is a `position` in the world and the rotation R_world_cam (OpenCV axes) as a quaternion w, x, y, z.
        Raises `OptionError` unless one of the three is given.
        """
        from list3r.queries.views.camera import camera_at_pose, camera_at_time, camera_of_frame

        posed = position is not None and quat_wxyz is not None
        if (frame is not None) + (time_s is not None) + posed != 1 or (position is None) != (quat_wxyz is None):
            raise OptionError("name one camera: by frame, by time, or by position and quaternion")
        if frame is not None:
            return camera_of_frame(self.store, frame, session)
        if time_s is not None:
            return camera_at_time(self.store, time_s, session)
        assert position is not None and quat_wxyz is not None
        return camera_at_pose(self.store, position, quat_wxyz, session)

    @_alone
    def relations(
        self,
        subject: int | str | Instance | None = None,
        predicate: str | None = None,
        object: int | str | Instance | None = None,
        min_confidence: float = 0.0,
        *,
        viewpoint: Place | Instance | None = None,
        other: int | str | Instance | None = None,
    ) -> Relations:
        """Return the relations that match what is given, by instance, id or words; `state` is unknown if none can tell.

        left_of, right_of, in_front_of and behind need a `viewpoint` (an id, "camera", "camera:FRAME" or a point);
        `between` needs `object` and `other`. Raises `OptionError` for an unknown predicate.

            >>> memory.relations(predicate="left_of", object=4, viewpoint=(0.0, 0.0, 1.5))
            >>> memory.relations(predicate="between", object=4, other=7)
        """
        from list3r.queries.relations import relations

        a, b, c = (x.id if isinstance(x, Instance) else x for x in (subject, object, other))
        seen_from = viewpoint.id if isinstance(viewpoint, Instance) else viewpoint
        return relations(self.store, a, predicate, b, min_confidence, viewpoint=seen_from, other=c)

    @_alone
    def relations_of(self, instance_id: int | Instance) -> Rows[Relation]:
        """Return the stored relations of an instance, each once: `on`, but not its inverse `supports`."""
        from list3r.queries.relations import relations_of

        return Rows(relations_of(self.store, self.store.instances.get(id_of(instance_id)).id))

    @_alone
    def measure(self, a: int | Instance, b: int | Instance) -> InstanceDistance:
        """Return the distances of surfaces and of centres. Raises `UnknownIdError` and `OptionError`."""
        from list3r.queries.measure import measure

        return measure(self.store, id_of(a), id_of(b))

    @_alone
    def rooms(self) -> list[Room]:
        """Return the rooms, with their outlines, what is in each, and names by what stands in them or by a person.

        >>> [(room.id, room.name, round(room.area, 1)) for room in memory.rooms()]
        """
        from list3r.queries.rooms import rooms

        return rooms(self.store)

    @_alone
    def doorways(self) -> list[Doorway]:
        """Return the doorways between rooms."""
        return self.store.rooms.doorways()

    @_alone
    def room_path(self, start: int | str, end: int | str) -> RoomPath:
        """Return the way through the fewest doorways between two rooms, by ids or names. Raises `OptionError`."""
        from list3r.queries.rooms import room_path

        return room_path(self.store, start, end)

    @_alone
    def path_between(self, start: int | Instance, end: int | Instance, *, structure: bool = True) -> Relations:
        """Return the shortest chain of relations between two instances, with `structure` also over floor and walls."""
        from list3r.queries.path import path

        return path(self.store, id_of(start), id_of(end), structure=structure)

    @_alone
    def sessions(self) -> list[Session]:
        """Return the videos that the memory was made from, in order."""
        return self.store.sessions.all()

    @_alone
    def camera_poses(self, session: int | None = None) -> list[tuple[FrameRow, Sim3]]:
        """Return every posed frame in order, of one session or of all, with its `S_world_cam`."""
        return self.store.trajectory.poses(session)

    @_alone
    def pictures(self, instance_ids: Sequence[int | Instance] | None = None) -> list[KeyframePicture]:
        """Return the keyframes with a stored picture, and the instances in each; or only those of some instances."""
        from list3r.queries.pictures import keyframe_pictures

        return keyframe_pictures(self.store, None if instance_ids is None else [id_of(i) for i in instance_ids])

    @_alone
    def picture(self, instance_id: int | Instance) -> InstancePicture:
        """Return the stored picture that shows an instance best, with its mask.

        Raises `UnknownIdError` and `OptionError`.

        >>> Image.fromarray(memory.picture(12).crop()).save("mug.png")
        """
        from list3r.queries.pictures import instance_picture

        return instance_picture(self.store, id_of(instance_id))

    @_alone
    def pixels(self, picture: KeyframePicture) -> NDArray[np.uint8]:
        """Return the pixels of one of `pictures()`, RGB. Shape (H, W, 3)."""
        from list3r.queries.pictures import keyframe_rgb

        return keyframe_rgb(self.store, picture)

    def prompt(self, tokens: int = 2000, question: str | None = None) -> ScenePrompt:
        """Return the memory as text for a language model, of at most `tokens` tokens; `str` of it is the text.

        With a `question` the things that its words name come first, then the things nearest to them. Tokens are counted
        by `list3r.exporters.prompt.tokens.count_tokens`. Raises `OptionError` if they are too few for the heading.

        >>> print(memory.prompt(1000, "what is on the table?"))
        """
        from list3r.exporters.prompt.scene_text import scene_prompt

        return scene_prompt(self, tokens, question)

    @_alone
    def relation_graph(self) -> networkx.MultiDiGraph:
        """Return instances and relations as a graph."""
        from list3r.memory.store.search.graphs import relation_graph

        return relation_graph(self.store)

    @_alone
    def merge_graph(self) -> networkx.Graph:
        """Return local instances, and the decisions that joined them, as a graph."""
        from list3r.memory.store.search.graphs import merge_graph

        return merge_graph(self.store)

    @_alone
    def export(
        self, format: str | Path, path: str | Path | None = None, **options: Unpack[ExportOptions]
    ) -> tuple[Path, ...]:
        """Write the memory in one of `list3r.exporters.registry.FORMATS`; a file alone says its format by its suffix.

        Returns the files written: `path`, and more beside it if the memory has several connected components. `colmap`,
        `nerfstudio` and `prompt` are folders. `color` of ply and glb is rgb or instance; `tokens` and `question` of
        prompt are those of `prompt()`. Raises `OptionError` and `ExportError`.

            >>> memory.export("house.glb")
            >>> memory.export("ply", "house.ply", color="rgb")
        """
        from list3r.exporters.registry import export as export_memory
        from list3r.exporters.registry import format_of

        if path is None:
            format, path = format_of(format), format
        with self.store.snapshot():
            return export_memory(self, str(format), path, **options)

    def close(self) -> None:
        """Close the file."""
        with self._lock:
            self.store.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.store.__exit__(kind, error, trace)
