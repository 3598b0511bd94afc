"""Global instances, their observations, embeddings, relations, aliases and the merge log: what is concluded."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from list3r.memory.codec import dequantise, raw_array, to_json
from list3r.memory.embedding_verbs import EmbeddingVerbs
from list3r.memory.errors import UnknownIdError
from list3r.memory.geometry import OrientedBox, Sim3
from list3r.memory.records import BestView, Instance, MergeDecision, Observation, Relation, Support

_COLUMNS = (
    "id, label, description, geometry, confidence, observations, first_seen_s, last_seen_s, state, structure,"
    " color_rgb, color_name, component, view_session, view_frame, view_box, dynamic,"
    " position_sigma_m"
)


_BATCH = 500
"""Rows asked for by id in one statement."""


class InstanceVerbs(EmbeddingVerbs):
    """Reading and writing the library. Writing verbs are called inside `transaction()`."""

    # ------------------------------------------------------------------ instances

    def instances(self, *, structure: bool | None = None) -> list[Instance]:
        """All instances by id; only structure or only things where asked."""
        where = {None: "", True: "WHERE structure IS NOT NULL", False: "WHERE structure IS NULL"}[structure]
        rows = self._rows(f"SELECT {_COLUMNS} FROM instances {where} ORDER BY id")
        return [_instance(row) for row in self._believed("instances", rows)]

    def instance(self, instance_id: int) -> Instance:
        """One instance; an alias gives the instance it was merged into. Raises `UnknownIdError`."""
        resolved = self.resolve(instance_id)
        rows = self._rows(f"SELECT {_COLUMNS} FROM instances WHERE id = ?", (resolved,))
        return _instance(self._believed("instances", rows)[0])

    def instances_of(self, ids: Sequence[int]) -> list[Instance]:
        """The instances of these ids that are there, in the order of `ids`; aliases are not resolved."""
        found: dict[int, Instance] = {}
        for start in range(0, len(ids), _BATCH):
            part = [int(i) for i in ids[start : start + _BATCH]]
            marks = ",".join("?" * len(part))
            rows = self._rows(f"SELECT {_COLUMNS} FROM instances WHERE id IN ({marks})", tuple(part))
            for row in self._believed("instances", rows):
                found[row[0]] = _instance(row)
        return [found[i] for i in map(int, ids) if i in found]

    def resolve(self, instance_id: int) -> int:
        """The id that stands for an id today. Raises `UnknownIdError` for an id the memory has never held."""
        seen = set()
        current = int(instance_id)
        while current not in seen:
            seen.add(current)
            if self._rows("SELECT 1 FROM instances WHERE id = ?", (current,)):
                return current
            target = self._rows("SELECT instance FROM aliases WHERE id = ?", (current,))
            if not target:
                break
            current = int(target[0][0])
        raise UnknownIdError(f"{self.path} has no instance {instance_id}; `list3r list {self.path}` shows the ids")

    def put_instances(self, instances: Iterable[Instance]) -> None:
        """Write instances, new or changed, with their boxes in the R*Tree."""
        rows = list(instances)
        marks = ",".join("?" * 18)
        self._database.executemany(
            f"INSERT OR REPLACE INTO instances ({_COLUMNS}) VALUES ({marks})", [_instance_row(i) for i in rows]
        )
        self._database.executemany(
            "INSERT OR REPLACE INTO instance_boxes VALUES (?, ?, ?, ?, ?, ?, ?)",
            [(i.id, *(float(x) for x in i.aabb.T.ravel())) for i in rows],
        )

    def drop_instance(self, instance_id: int, alias_of: int | None) -> None:
        """Take an instance out; its id lives on as an alias of another, or resolves no more."""
        self.vectors_touched.append(int(instance_id))
        for table, column in (
            ("instances", "id"),
            ("instance_boxes", "id"),
            ("embeddings", "instance"),
            ("anchors", "instance"),
        ):
            self._database.execute(f"DELETE FROM {table} WHERE {column} = ?", (instance_id,))
        self._database.execute("DELETE FROM relations WHERE subject = ? OR object = ?", (instance_id, instance_id))
        if alias_of is not None:
            query = "UPDATE OR IGNORE events SET instance = ? WHERE instance = ?"
            self._database.execute(query, (alias_of, instance_id))
        self._database.execute("DELETE FROM events WHERE instance = ?", (instance_id,))
        if alias_of is not None:
            self._database.execute("INSERT OR REPLACE INTO aliases VALUES (?, ?)", (instance_id, alias_of))

    def states(self) -> dict[int, tuple[str, int]]:
        """State and component of every instance, by id."""
        return {n: (state, part) for n, state, part in self._rows("SELECT id, state, component FROM instances")}

    def set_states(self, states: Mapping[int, str]) -> None:
        """Write the state of instances, by id."""
        self._database.executemany(
            "UPDATE instances SET state = ? WHERE id = ?", [(state, n) for n, state in sorted(states.items())]
        )

    def next_id(self) -> int:
        """The smallest id that was never used; ids are not used again."""
        query = "SELECT max((SELECT coalesce(max(id), 0) FROM instances), (SELECT coalesce(max(id), 0) FROM aliases))"
        return max(int(self._rows(query)[0][0]), int(self.get_value("last_id", 0))) + 1

    def aliases(self) -> dict[int, int]:
        """Every retired id and the id it was merged into."""
        return {r[0]: r[1] for r in self._rows("SELECT id, instance FROM aliases ORDER BY id")}

    def ids_in_box(self, lower: ArrayLike, upper: ArrayLike) -> list[int]:
        """Ids whose axis-aligned boxes meet the box, from the R*Tree. World coordinates, shape (3,) each."""
        low, high = np.asarray(lower, dtype=float), np.asarray(upper, dtype=float)
        query = (
            "SELECT id FROM instance_boxes WHERE max_x >= ? AND min_x <= ? AND max_y >= ? AND min_y <= ?"
            " AND max_z >= ? AND min_z <= ? ORDER BY id"
        )
        arguments = tuple(float(x) for pair in zip(low, high, strict=True) for x in pair)
        return [r[0] for r in self._rows(query, arguments)]

    def boxes_in_box(
        self,
        lower: ArrayLike,
        upper: ArrayLike,
        *,
        structure: bool = True,
        min_confidence: float = 0.0,
        state: str | None = None,
        component: int | None = None,
        limit: int = -1,
    ) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Ids (N,) and boxes (N, 2, 3) of the instances whose boxes meet a box, at most `limit`, in no order.

        The boxes are those of the R*Tree: single precision, rounded outward. Without `structure` things only.
        """
        low, high = np.asarray(lower, dtype=float), np.asarray(upper, dtype=float)
        arguments: list[float | int | str] = [float(x) for pair in zip(low, high, strict=True) for x in pair]
        clauses = ""
        if not structure:
            clauses += " AND i.structure IS NULL"
        if min_confidence > 0.0:
            clauses, arguments = f"{clauses} AND i.confidence >= ?", [*arguments, min_confidence]
        if state is not None:
            clauses, arguments = f"{clauses} AND i.state = ?", [*arguments, state]
        if component is not None:
            clauses, arguments = f"{clauses} AND i.component = ?", [*arguments, component]
        join = " CROSS JOIN instances i ON i.id = b.id" if clauses else ""
        query = (
            f"SELECT b.id, b.min_x, b.min_y, b.min_z, b.max_x, b.max_y, b.max_z FROM instance_boxes b{join}"
            " WHERE b.max_x >= ? AND b.min_x <= ? AND b.max_y >= ? AND b.min_y <= ? AND b.max_z >= ? AND b.min_z <= ?"
            f"{clauses} LIMIT ?"
        )
        rows = np.array(self._rows(query, (*arguments, limit)), dtype=np.float64).reshape(-1, 7)
        return rows[:, 0].astype(np.int64), rows[:, 1:].reshape(-1, 2, 3)

    def world_bounds(self) -> NDArray[np.float64] | None:
        """Box around the boxes of all instances, read off the root of the R*Tree; None without any. Shape (2, 3)."""
        rows = self._rows("SELECT data FROM instance_boxes_node WHERE nodeno = 1")
        if not rows or len(rows[0][0]) < 4:
            return None
        return _bounds(rows[0][0])

    # ------------------------------------------------------------------ observations and supports

    def set_observations(self, observations: Iterable[Observation]) -> None:
        """Say which instance each local instance belongs to."""
        self._database.executemany(
            "INSERT OR REPLACE INTO observations VALUES (?, ?, ?)",
            [(o.chunk_id, o.local_id, o.instance_id) for o in observations],
        )

    def clear_observations(self) -> None:
        """Forget which instance each local instance belongs to, before all of it is said anew."""
        self._database.execute("DELETE FROM observations")

    def observations(self, instance_id: int | None = None) -> list[Observation]:
        """Which local instances make up an instance, or all of them."""
        where, arguments = ("", ()) if instance_id is None else ("WHERE instance = ?", (self.resolve(instance_id),))
        query = f"SELECT instance, chunk_id, local_id FROM observations {where} ORDER BY chunk_id, local_id"
        return [Observation(*r) for r in self._rows(query, arguments)]

    def support(self, instance_id: int) -> Support:
        """All surface points of an instance, in the world as it is placed now; of what moves, where it was last."""
        instance = self.instance(instance_id)
        parts = self._support_parts(instance.id)
        chunks = self._poses({k for k, _ in parts})
        found = Support(
            np.concatenate([chunks[k].apply(s.points) for k, s in parts]).astype(np.float32)
            if parts
            else np.zeros((0, 3), np.float32),
            np.concatenate([s.confidence for _, s in parts]) if parts else np.zeros(0, np.float32),
            np.concatenate([s.rgb for _, s in parts]) if parts else np.zeros((0, 3), np.uint8),
        )
        moves = "SELECT 1 FROM events WHERE instance = ? AND kind = 'moved' LIMIT 1"
        if not instance.dynamic and not self._rows(moves, (instance.id,)):
            return found
        slack = 0.05 * float(np.linalg.norm(np.ptp(instance.aabb, axis=0)))
        here = np.all((found.points >= instance.aabb[0] - slack) & (found.points <= instance.aabb[1] + slack), axis=1)
        return Support(found.points[here], found.confidence[here], found.rgb[here])

    def surface_points(self, instance_id: int) -> NDArray[np.float32]:
        """Support points of one instance (no alias) in the world, without their colours. Shape (N, 3)."""
        query = (
            "SELECT s.chunk_id, s.local_id, s.count, s.grid, s.points FROM observations o"
            " JOIN supports s USING (chunk_id, local_id) WHERE o.instance = ? ORDER BY s.chunk_id, s.local_id"
        )
        rows = self._rows(query, (int(instance_id),))
        if not rows:
            return np.zeros((0, 3), np.float32)
        placed = self._poses({row[0] for row in rows})
        parts = [
            placed[k].apply(dequantise(grid, points, count, f"the support of local instance {k}:{n}"))
            for k, n, count, grid, points in rows
        ]
        return np.concatenate(parts).astype(np.float32)

    def _poses(self, chunk_ids: Iterable[int]) -> dict[int, Sim3]:
        """S_world_chunk of some chunks."""
        return {k: self.chunk(k).S_world_chunk for k in sorted(chunk_ids)}

    def node_checksums(self) -> dict[int, int]:
        """A checksum, by chunk id, of what each chunk measured, of how many local instances it has and which move."""
        out = self.chunk_checksums()
        for chunk_id, count in self._rows("SELECT chunk_id, count(*) FROM local_instances GROUP BY chunk_id"):
            out[chunk_id] = (out[chunk_id] * 31 + 104729 * count) & 0xFFFFFFFF
        query = (
            "SELECT chunk_id, local_id, length(motion) FROM local_instances WHERE dynamic ORDER BY chunk_id, local_id"
        )
        for chunk_id, local_id, length in self._rows(query):
            out[chunk_id] = (out[chunk_id] * 31 + 7919 * (local_id + 1) + (length or 0)) & 0xFFFFFFFF
        return out

    def node_checksum(self, chunk_id: int) -> int:
        """The same of one chunk; another one after a rollback, when its id may stand for another chunk."""
        moving = self._rows(
            "SELECT local_id, length(motion) FROM local_instances WHERE dynamic AND chunk_id = ? ORDER BY local_id",
            (int(chunk_id),),
        )
        count = self._rows("SELECT count(*) FROM local_instances WHERE chunk_id = ?", (int(chunk_id),))
        return hash((self.rollbacks, self.chunk_checksums().get(int(chunk_id), 0), count[0][0], *moving))

    def track(self, instance_id: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Where a moving instance was: seconds of shape (V,) and places in the world of shape (V, 3), in order of time.

        Frames that two chunks saw count once, at the mean of what they say. In frames in which it stood still for a
        whole chunk the middle of its surface is its place. Nothing for an instance that was never seen moving.
        """
        _, times_s, places = self.track_frames(instance_id)
        return times_s, places

    def track_frames(self, instance_id: int) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
        """`track` with the frames it comes from: (session id, Frame.index) (V, 2), seconds (V,), places (V, 3)."""
        resolved = self.resolve(instance_id)
        empty = np.zeros((0, 2), np.int64), np.zeros(0), np.zeros((0, 3))
        if not self.instance(resolved).dynamic:
            return empty
        chunks = {c.chunk_id: c for c in self.chunks()}
        moving: dict[tuple[int, int], list[NDArray[np.float64]]] = {}
        still: dict[tuple[int, int], list[NDArray[np.float64]]] = {}
        for o in self.observations(resolved):
            chunk, motion = chunks[o.chunk_id], self.motion_track(o.chunk_id, o.local_id)
            if motion is not None and len(motion.frames):
                frames, places, found = motion.frames, chunk.S_world_chunk.apply(motion.positions), moving
            else:
                frames = self.mask_track(o.chunk_id, o.local_id).frames
                places, found = np.tile(self._middle(o, chunk.S_world_chunk), (len(frames), 1)), still
            for frame, place in zip(frames.tolist(), places, strict=True):
                found.setdefault((chunk.session_id, frame), []).append(place)
        seen = {**still, **moving}
        times = {(f.session_id, f.frame_index): f.time_s for f in self.frames()}
        keys = [k for k in sorted(seen) if k in times]
        if not keys:
            return empty
        places = np.array([np.mean(seen[k], axis=0) for k in keys])
        return np.array(keys, np.int64), np.array([times[k] for k in keys]), places

    def _middle(self, observation: Observation, S_world_chunk: Sim3) -> NDArray[np.float64]:
        """Middle of the surface of one local instance, world. Shape (3,)."""
        query = (
            "SELECT chunk_id, local_id, count, grid, points, confidence, rgb FROM supports"
            " WHERE chunk_id = ? AND local_id = ?"
        )
        rows = self._rows(query, (observation.chunk_id, observation.local_id))
        points = _support_part(rows[0])[1].points if rows else np.zeros((0, 3), np.float32)
        if len(points) == 0:
            return np.full(3, np.nan)
        return np.asarray(np.quantile(S_world_chunk.apply(points), [0.02, 0.98], axis=0).mean(axis=0))

    def _support_parts(self, instance_id: int) -> list[tuple[int, Support]]:
        query = (
            "SELECT s.chunk_id, s.local_id, s.count, s.grid, s.points, s.confidence, s.rgb FROM observations o"
            " JOIN supports s USING (chunk_id, local_id) WHERE o.instance = ? ORDER BY s.chunk_id, s.local_id"
        )
        return [_support_part(row) for row in self._rows(query, (instance_id,))]

    # ------------------------------------------------------------------ relations

    def replace_relations(self, subjects: Iterable[int] | None, relations: Iterable[Relation]) -> None:
        """Replace all relations that touch these instances (all relations when `subjects` is None)."""
        if subjects is None:
            self._database.execute("DELETE FROM relations")
        else:
            ids = [(int(i),) for i in subjects]
            self._database.executemany("DELETE FROM relations WHERE subject = ?", ids)
            self._database.executemany("DELETE FROM relations WHERE object = ?", ids)
        self._database.executemany(
            "INSERT OR REPLACE INTO relations VALUES (?, ?, ?, ?, ?)",
            [(r.subject, r.predicate, r.object, float(r.confidence), float(r.margin)) for r in relations],
        )

    def relations(
        self, subject: int | None = None, predicate: str | None = None, object: int | None = None
    ) -> list[Relation]:
        """Relations that match what is given; ids may be aliases."""
        clauses: list[str] = []
        arguments: list[int | str] = []
        for column, value in (("subject", subject), ("object", object)):
            if value is not None:
                clauses.append(f"{column} = ?")
                arguments.append(self.resolve(value))
        if predicate is not None:
            clauses.append("predicate = ?")
            arguments.append(predicate)
        where = f"WHERE {' AND '.join(clauses)}" if clauses else ""
        query = (
            f"SELECT subject, predicate, object, confidence, margin FROM relations {where}"
            " ORDER BY subject, predicate, object"
        )
        return [Relation(*r) for r in self._rows(query, tuple(arguments))]

    # ------------------------------------------------------------------ the merge log

    def log_decisions(self, chunk_id: int, decisions: Iterable[MergeDecision]) -> None:
        """Append to the merge log what was decided when a chunk arrived."""
        self._database.executemany(
            "INSERT INTO merges (chunk_id, kind, a, b, scores, reason) VALUES (?, ?, ?, ?, ?, ?)",
            [(chunk_id, d.kind, d.a, d.b, to_json(d.scores), d.reason) for d in decisions],
        )

    def has_decided(self, kind: str, a: str, b: str) -> bool:
        """Whether the log holds a decision of this kind on these two."""
        return bool(self._rows("SELECT 1 FROM merges WHERE a = ? AND b = ? AND kind = ? LIMIT 1", (a, b, kind)))

    def has_moving(self) -> bool:
        """Whether any local instance was seen moving."""
        return bool(self._rows("SELECT 1 FROM local_instances WHERE dynamic LIMIT 1"))

    def instance_count(self) -> tuple[int, int]:
        """How many things and how many pieces of structure there are."""
        total, things = self._rows("SELECT count(*), count(*) - count(structure) FROM instances")[0]
        return int(things), int(total) - int(things)

    def observed_as(self, keys: Sequence[tuple[int, int]]) -> dict[tuple[int, int], int]:
        """The instances of these local instances (chunk id, local id) that belong to one."""
        wanted, chunks = set(keys), sorted({int(k) for k, _ in keys})
        out: dict[tuple[int, int], int] = {}
        for start in range(0, len(chunks), _BATCH):
            part = tuple(chunks[start : start + _BATCH])
            marks = ",".join("?" * len(part))
            query = f"SELECT chunk_id, local_id, instance FROM observations WHERE chunk_id IN ({marks})"
            out |= {(k, n): i for k, n, i in self._rows(query, part) if (k, n) in wanted}
        return out

    def forget_observations(self, keys: Iterable[tuple[int, int]]) -> None:
        """Forget which instances these local instances belong to."""
        self._database.executemany("DELETE FROM observations WHERE chunk_id = ? AND local_id = ?", list(keys))

    def decisions(self) -> list[MergeDecision]:
        """The merge log, oldest first."""
        query = "SELECT kind, a, b, scores, reason FROM merges ORDER BY entry"
        return [MergeDecision(r[0], r[1], r[2], json.loads(r[3]), r[4]) for r in self._rows(query)]


@lru_cache(maxsize=16)
def _bounds(node: bytes) -> NDArray[np.float64] | None:
    """Box around what a node of the R*Tree holds, None where that is nothing; not to be changed. Shape (2, 3)."""
    count = int.from_bytes(node[2:4], "big")
    cell = np.dtype([("id", ">i8"), ("span", ">f4", 6)])
    if count == 0 or len(node) < 4 + count * cell.itemsize:
        return None
    span = np.frombuffer(node, cell, count, 4)["span"].astype(np.float64)
    bounds = np.stack([span[:, 0::2].min(axis=0), span[:, 1::2].max(axis=0)])
    bounds.setflags(write=False)
    return bounds


def _support_part(row: tuple[Any, ...]) -> tuple[int, Support]:
    """(chunk id, support in chunk coordinates) of a row of `supports`."""
    chunk_id, local_id, count, grid, points, weight, rgb = row
    where = f"the support of local instance {chunk_id}:{local_id}"
    support = Support(
        dequantise(grid, points, count, where),
        raw_array(weight, "u1", (count,), where).astype(np.float32) / 255.0,
        raw_array(rgb, "u1", (count, 3), where).copy(),
    )
    return chunk_id, support


def _instance_row(instance: Instance) -> tuple[object, ...]:
    box = instance.box
    geometry = np.concatenate([instance.center, instance.aabb.ravel(), box.center, box.size, box.rotation.ravel()])
    r, g, b = instance.color_rgb
    view = instance.best_view
    return (
        instance.id,
        instance.label,
        instance.description,
        geometry.astype("<f8").tobytes(),
        float(instance.confidence),
        int(instance.observations),
        float(instance.first_seen_s),
        float(instance.last_seen_s),
        instance.state,
        instance.structure,
        int(r) << 16 | int(g) << 8 | int(b),
        instance.color_name,
        int(instance.component),
        None if view is None else view.session_id,
        None if view is None else int(view.frame_index),
        None if view is None else np.asarray(view.box_xyxy, dtype="<f8").tobytes(),
        int(instance.dynamic),
        instance.position_sigma_m,
    )


def _instance(row: tuple[Any, ...]) -> Instance:
    where = f"the geometry of instance {row[0]}"
    g = raw_array(row[3], "<f8", (24,), where).copy()
    view = None
    if row[13] is not None:
        x0, y0, x1, y1 = (float(x) for x in raw_array(row[15], "<f8", (4,), where))
        view = BestView(row[13], row[14], (x0, y0, x1, y1))
    return Instance(
        id=row[0],
        label=row[1],
        description=row[2],
        center=g[:3],
        aabb=g[3:9].reshape(2, 3),
        box=OrientedBox(g[9:12], g[12:15], g[15:24].reshape(3, 3)),
        confidence=row[4],
        observations=row[5],
        first_seen_s=row[6],
        last_seen_s=row[7],
        state=row[8],
        structure=row[9],
        color_rgb=(row[10] >> 16 & 255, row[10] >> 8 & 255, row[10] & 255),
        color_name=row[11],
        component=row[12],
        best_view=view,
        dynamic=bool(row[16]),
        position_sigma_m=row[17],
    )
