"""Lists of very many frames: names that lead out are refused wherever they stand, fingerprints stay what they were."""

from __future__ import annotations

from pathlib import Path

import pytest

from list3r.frames.folder import fingerprint
from list3r.frames.layout import inside
from list3r.frames.options import SourceOptions
from list3r.memory.errors import SourceError


@pytest.mark.parametrize("name", ["../a.jpg", "p/../../a.jpg", "/etc/passwd", "..", "p/..", "p/out.jpg", "q/a.jpg"])
def test_a_name_or_link_that_leads_out_is_refused(name: str, tmp_path: Path) -> None:
    root = tmp_path / "walk"
    (root / "p").mkdir(parents=True)
    (root / "p/a.jpg").write_bytes(b"x")
    (tmp_path / "other").mkdir()
    (root / "q").symlink_to(tmp_path / "other")
    (root / "p/out.jpg").symlink_to(tmp_path / "other/a.jpg")
    (root / "p/within.jpg").symlink_to(root / "p/a.jpg")
    assert inside(root, "p/a.jpg", root) == root / "p/a.jpg"
    assert inside(root, "p/within.jpg", root) == root / "p/within.jpg"
    if name == "p/..":
        assert inside(root, name, root).resolve() == root
        return
    with pytest.raises(SourceError, match="outside"):
        inside(root, name, root)


def test_the_fingerprint_of_a_list_is_what_it_was() -> None:
    rows = [("a'b.jpg", 3), ("ü.png", -1)]
    assert fingerprint("tum", iter(rows), SourceOptions()) == "448e26ca744dd0517f9e004f3a10c4a1"
    assert len({fingerprint("tum", listing, SourceOptions()) for listing in (rows, rows[:1], [])}) == 3
