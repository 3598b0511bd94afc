"""What has changed between sessions: facts on small worlds made by hand."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest

from list3r.memory.core.errors import OptionError
from list3r.memory.core.geometry import Array, Sim3
from list3r.memory.core.records import ChangeEvent
from list3r.memory.library.consolidation import consolidate
from list3r.memory.library.maintenance.history import world_at
from list3r.memory.library.overlap.visibility import DepthView, place_visibility
from list3r.memory.store.store import Store
from list3r.queries.changes import changes

CAMERA = (130.0, 130.0, 79.5, 59.5)


def _view(depth: Array | float, frame: int = 0, x: float = 0.0) -> DepthView:
    """A camera at (x, 0, 0) that looks along z at a wall, or at what `depth` says."""
    picture = np.full((120, 160), depth, np.float32) if np.isscalar(depth) else np.asarray(depth, np.float32)
    return DepthView(1, frame, Sim3(1.0, np.eye(3), np.array([-x, 0.0, 0.0])), 1.0, picture, CAMERA)


def _patch(z: float = 2.0, half: float = 0.06, count: int = 12) -> Array:
    """A square of surface points in front of the camera."""
    side = np.linspace(-half, half, count)
    return np.array([[x, y, z] for x in side for y in side])


def test_a_surface_at_its_place_is_there() -> None:
    found = place_visibility(_patch(), [_view(2.01, 0), _view(1.99, 1, 0.1)])
    assert found.verdict == "there"
    assert found.free == 0.0
    assert len(found.frames) == 2


def test_free_space_through_a_place_means_gone_and_needs_four_frames() -> None:
    views = [_view(2.6, k, 0.05 * k) for k in range(4)]
    assert place_visibility(_patch(), views).verdict == "gone"
    assert place_visibility(_patch(), views[:3]).verdict != "gone"


@pytest.mark.parametrize("depth", [1.2, 0.0])
def test_what_is_hidden_or_without_depth_is_unseen(depth: float) -> None:
    assert place_visibility(_patch(), [_view(depth, 0), _view(depth, 1)]).verdict == "unseen"


def test_what_lies_outside_the_picture_is_unseen() -> None:
    assert place_visibility(_patch() + np.array([5.0, 0.0, 0.0]), [_view(2.6, 0), _view(2.6, 1)]).verdict == "unseen"
    assert place_visibility(_patch() * np.array([1, 1, -1]), [_view(2.6, 0), _view(2.6, 1)]).verdict == "unseen"
    assert place_visibility(_patch(), []).verdict == "unseen"


def test_an_edge_beside_the_place_is_not_free_space() -> None:
    """A small error of alignment shows the background through the rim of a thing, not through its middle."""
    picture = np.full((120, 160), 2.6, np.float32)
    picture[52:68, 73:89] = 2.0
    assert (
        place_visibility(_patch() + np.array([0.01, 0.0, 0.0]), [_view(picture, 0), _view(picture, 1)]).verdict
        == "there"
    )


def _event(kind: str, session: int, instance: int, moved: float = 1.0) -> ChangeEvent:
    from list3r.memory.core.geometry import OrientedBox

    here, there = (OrientedBox(np.array([x, 0.0, 0.0]), np.full(3, 0.1), np.eye(3)) for x in (0.0, moved))
    before, after = {"added": (None, there), "removed": (here, None)}.get(kind, (here, there))
    return ChangeEvent(session, instance, kind, before, after, ((session, 7), (session, 9)), 0.8, "for a test")


def test_events_come_back_as_they_were_written(tmp_path: Path) -> None:
    with Store.create(tmp_path / "a.l3r") as store:
        written = [_event(kind, 2, n) for n, kind in enumerate(("moved", "removed", "added", "seen_again"), 1)]
        with store.transaction():
            store.events.replace(written)
        read = store.events.all()
        assert [e.kind for e in read] == ["moved", "removed", "added", "seen_again"]
        for a, b in zip(written, read, strict=True):
            assert (a.session_id, a.instance_id, a.frames, a.confidence, a.reason) == (
                b.session_id,
                b.instance_id,
                b.frames,
                b.confidence,
                b.reason,
            )
            for x, y in ((a.from_box, b.from_box), (a.to_box, b.to_box)):
                assert (x is None) == (y is None)
                if x is not None and y is not None:
                    np.testing.assert_array_equal(x.center, y.center)
                    np.testing.assert_array_equal(x.rotation, y.rotation)
        assert store.events.all(1) == []


def test_unknown_sessions_and_kinds_are_refused(tmp_path: Path) -> None:
    with Store.create(tmp_path / "a.l3r") as store:
        assert changes(store) == []
        with pytest.raises(OptionError, match="no session 3"):
            changes(store, since=3)
        with pytest.raises(OptionError, match="not known"):
            changes(store, kinds=("vanished",))
        with pytest.raises(OptionError, match="no session 4"):
            world_at(store, 4)


def test_a_memory_of_one_session_has_no_events(tmp_path: Path) -> None:
    with Store.create(tmp_path / "a.l3r") as store:
        with store.transaction():
            consolidate(store)
        assert _kinds(store.events.all()) == []


def _kinds(events: Iterable[ChangeEvent]) -> list[str]:
    return [e.kind for e in events]
