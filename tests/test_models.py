"""Model cards, licences, the cache of weights, presets: no network needed, a hub of our own answers."""

from __future__ import annotations

import hashlib
import json
import threading
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.util import find_spec
from pathlib import Path
from typing import ClassVar
from urllib.parse import urlparse

import pytest
import torch
from safetensors.torch import save_file

import list3r
from list3r.instances.registry import DISCOVERERS, FEATURES, TRACKERS
from list3r.memory.core.errors import OptionError
from list3r.models.cache import (
    cache_folder,
    check_weights,
    fetch,
    find_cached,
    locate,
    resolve,
    split_name,
)
from list3r.models.cards import (
    APACHE,
    CARDS,
    CC_BY_NC,
    PARTS,
    SAM_LICENCE,
    UNPINNED,
    Licence,
    ModelCard,
    Weights,
    cards_named,
    find_card,
)
from list3r.models.choice import check_allowed, parse_weights, pinned_weights
from list3r.models.device import Gpu
from list3r.models.licences import PROFILES, choose_weights, objection, terms
from list3r.models.presets import ModelSelection, obstacle, select
from list3r.models.upstream import load_upstream, upstream_class
from list3r.pipeline.request import RunOptions
from list3r.pipeline.session import prepare, with_weights
from list3r.pipeline.settings import BuildSettings
from list3r.reconstruction.registry import MODELS
from list3r.semantics.embedding import embed_memory
from tests import neural_scenes

GPU = Gpu("a GPU", 24_000.0, 23_000.0)
COMMIT = "0123456789abcdef0123456789abcdef01234567"


@pytest.fixture(autouse=True)
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cache that is empty."""
    monkeypatch.setenv("HF_HUB_CACHE", str(tmp_path / "hub"))
    monkeypatch.delenv("HF_HUB_OFFLINE", raising=False)
    return tmp_path / "hub"


def put(repository: str, branch: str = "main") -> Path:
    """Weights in the cache, as the hub's package lays them, at the card's commit where it has one; the folder."""
    pinned = (w.revision for c in CARDS for w in c.weights if w.repository == repository and w.pinned)
    commit = next(pinned, COMMIT)
    base = cache_folder() / f"models--{repository.replace('/', '--')}"
    folder = base / "snapshots" / commit
    folder.mkdir(parents=True)
    (base / "refs").mkdir(exist_ok=True)
    (base / "refs" / branch).write_text(commit)
    save_file({"x": torch.zeros(4)}, folder / "model.safetensors")
    return folder


def card(code: Licence = APACHE, *weights: Weights) -> ModelCard:
    return ModelCard("thing", "geometry", code, weights, ("json",), "pip install thing")


def test_every_adapter_has_a_card_and_every_card_an_adapter() -> None:
    known = {("geometry", m) for m in MODELS if m not in ("rgbd", "sfm", "precomputed")}
    known |= {("discovery", d) for d in DISCOVERERS if d not in ("learned", "precomputed")}
    known |= {("tracking", t) for t in TRACKERS if t != "reprojection"}
    known |= {("features", f) for f in FEATURES if f not in ("geometric", "own")}
    carded = {(c.part, c.name) for c in CARDS}
    assert known <= carded
    assert {pair for pair in carded if pair[0] in ("geometry", "discovery", "tracking", "features")} == known
    assert all(c.part in PARTS and c.packages and c.installed_by for c in CARDS)
    assert len(carded) == len(CARDS)


def test_a_revision_is_a_commit_or_says_that_it_is_none() -> None:
    for weights in (w for c in CARDS for w in c.weights):
        assert weights.revision == UNPINNED or len(weights.revision) == 40
        assert weights.pinned == (weights.revision != UNPINNED)


@pytest.mark.parametrize(
    ("licence", "gated", "allowed"),
    [
        (APACHE, False, ("permissive", "research", "any")),
        (APACHE, True, ("research", "any")),
        (CC_BY_NC, False, ("research", "any")),
        (SAM_LICENCE, True, ("research", "any")),
        (Licence("GPL-3.0", "copyleft"), False, ("research", "any")),
        (Licence("no licence file", "none"), False, ("any",)),
    ],
)
def test_profiles_allow_what_they_say(licence: Licence, gated: bool, allowed: tuple[str, ...]) -> None:
    weights = Weights("a/b", licence, gated)
    for profile in PROFILES:
        assert (objection(card(APACHE, weights), weights, profile) is None) == (profile in allowed)
        if not gated:
            assert (objection(card(licence), None, profile) is None) == (profile in allowed)


def test_a_refusal_names_model_licence_and_way_out() -> None:
    pi3 = find_card("pi3", "geometry")
    assert pi3 is not None and not pi3.commercial
    with pytest.raises(
        OptionError, match=r"--reconstruction pi3: the weights yyfz233/Pi3 are under CC-BY-NC.*research"
    ):
        choose_weights(pi3, None, "permissive", "--reconstruction")
    with pytest.raises(OptionError, match="--licence free is not known"):
        choose_weights(pi3, None, "free", "--reconstruction")
    assert "CC-BY-NC" in terms(pi3, pi3.weights[0])


def test_a_profile_takes_the_first_weights_that_it_allows() -> None:
    both = card(APACHE, Weights("a/nc", CC_BY_NC), Weights("a/free", APACHE))
    free = choose_weights(both, None, "permissive", "--x")
    assert free is not None and free.repository == "a/free"
    with pytest.raises(OptionError, match="someone/else are under other"):
        choose_weights(both, "someone/else", "permissive", "--x")
    assert choose_weights(both, "/my/own", "permissive", "--x") is None
    with pytest.raises(OptionError, match="a/nc"):
        choose_weights(both, "a/nc@main", "permissive", "--x")


def test_cached_weights_are_found_by_branch_and_commit() -> None:
    folder = put("a/b")
    cached = find_cached("a/b")
    assert cached is not None and cached.commit == COMMIT and cached.folder == folder
    assert cached.size_bytes == (folder / "model.safetensors").stat().st_size
    assert cached.name == f"a/b@{COMMIT}"
    assert find_cached("a/b", COMMIT) == cached
    assert find_cached("a/b", "f" * 40) is None and find_cached("a/c") is None
    (folder / "model.safetensors").unlink()
    assert find_cached("a/b") is None, "a folder without weights is no copy"
    assert split_name("a/b@v1") == ("a/b", "v1") and split_name("weights.pt") is None


def test_what_is_in_the_cache_needs_no_network(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    folder = put("yyfz233/Pi3")
    pi3 = find_card("pi3", "geometry")
    assert pi3 is not None
    name = resolve(None, pi3.weights[0], "--reconstruction pi3")
    assert name == f"yyfz233/Pi3@{pi3.weights[0].revision}" and locate(name) == folder
    assert resolve("yyfz233/Pi3", None, "x") == name == resolve(name, None, "x")
    assert resolve(str(folder), None, "x") == str(folder.resolve())


@pytest.mark.parametrize("endpoint", ["http://127.0.0.1:9", "http://no-such-host.invalid"])
def test_without_network_and_copy_one_line_says_what_to_do(endpoint: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HF_ENDPOINT", endpoint)
    _reload_hub(monkeypatch, endpoint)
    with pytest.raises(OptionError, match=r"list3r models fetch a/b") as caught:
        fetch(Weights("a/b", APACHE))
    assert "\n" not in str(caught.value)
    with pytest.raises(OptionError, match="are gone"):
        locate(f"a/b@{COMMIT}")


class _Hub(BaseHTTPRequestHandler):
    """As much of the hub as fetching a snapshot needs."""

    files: ClassVar[dict[str, bytes]] = {}
    gated = False
    asked: ClassVar[list[str]] = []

    def do_HEAD(self) -> None:
        self._answer(body=False)

    def do_GET(self) -> None:
        self._answer(body=True)

    def log_message(self, *arguments: object) -> None:
        """Quiet."""

    def _answer(self, body: bool) -> None:
        path = urlparse(self.path).path
        self.asked.append(path)
        parts = path.strip("/").split("/")
        if self.gated:
            return self._send(403, b"{}", {"X-Error-Code": "GatedRepo", "X-Error-Message": "gated"}, body)
        if parts[0] == "api" and "tree" in parts:
            listing = [
                {"type": "file", "path": n, "size": len(d), "oid": hashlib.sha1(d).hexdigest()}
                for n, d in self.files.items()
            ]
            return self._send(200, json.dumps(listing).encode(), {}, body)
        if parts[0] == "api":
            info = {"id": "a/b", "modelId": "a/b", "sha": COMMIT, "siblings": [{"rfilename": n} for n in self.files]}
            return self._send(200, json.dumps(info).encode(), {}, body)
        data = self.files.get(parts[-1])
        if data is None:
            return self._send(404, b"", {"X-Error-Code": "EntryNotFound"}, body)
        return self._send(200, data, {"ETag": f'"{hashlib.sha1(data).hexdigest()}"', "X-Repo-Commit": COMMIT}, body)

    def _send(self, status: int, data: bytes, headers: dict[str, str], body: bool) -> None:
        self.send_response(status)
        for name, value in {"Content-Length": str(len(data)), **headers}.items():
            self.send_header(name, value)
        self.end_headers()
        if body:
            self.wfile.write(data)


def _reload_hub(monkeypatch: pytest.MonkeyPatch, endpoint: str) -> None:
    """Point the hub's package, which reads its environment once, at another place and at the cache of this test."""
    from huggingface_hub import constants

    monkeypatch.setattr(constants, "ENDPOINT", endpoint)
    monkeypatch.setattr(constants, "HUGGINGFACE_CO_URL_TEMPLATE", endpoint + "/{repo_id}/resolve/{revision}/{filename}")
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(cache_folder()))
    monkeypatch.setattr(constants, "HF_HUB_DISABLE_XET", True)


@pytest.fixture
def hub(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[type[_Hub]]:
    save_file({"x": torch.arange(4.0)}, tmp_path / "m.safetensors")
    _Hub.files = {"model.safetensors": (tmp_path / "m.safetensors").read_bytes(), "config.json": b"{}"}
    _Hub.files["train.bin.zip"] = b"not wanted"
    _Hub.gated, _Hub.asked = False, []
    server = ThreadingHTTPServer(("127.0.0.1", 0), _Hub)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    _reload_hub(monkeypatch, f"http://127.0.0.1:{server.server_port}")
    yield _Hub
    server.shutdown()


def test_fetched_once_used_from_then_on(hub: type[_Hub]) -> None:
    cached = fetch(Weights("a/b", APACHE))
    assert cached.name == f"a/b@{COMMIT}"
    assert {p.name for p in cached.folder.iterdir()} == {"model.safetensors", "config.json"}
    check_weights(cached.folder)
    asked = len(hub.asked)
    assert resolve("a/b", None, "x") == cached.name
    assert len(hub.asked) == asked, "the branch stands for what was fetched, and nobody is asked again"


def test_old_files_are_fetched_where_there_is_nothing_newer(hub: type[_Hub]) -> None:
    hub.files = {"config.json": b"{}", "pytorch_model.bin": b"x" * 2000, "tf_model.h5": b"no"}
    cached = fetch(Weights("a/b", APACHE))
    assert {p.name for p in cached.folder.iterdir()} == {"pytorch_model.bin", "config.json"}
    check_weights(cached.folder)


def test_gated_weights_say_so(hub: type[_Hub]) -> None:
    hub.gated = True
    with pytest.raises(OptionError, match="its owner must grant access first"):
        fetch(Weights("a/b", SAM_LICENCE, gated=True))


def test_a_repository_without_weights_says_so(hub: type[_Hub]) -> None:
    hub.files = {"config.json": b"{}"}
    with pytest.raises(OptionError, match="no weights of a known form"):
        fetch(Weights("a/b", APACHE))


def test_truncated_and_foreign_files_are_named(tmp_path: Path) -> None:
    good = tmp_path / "model.safetensors"
    save_file({"x": torch.zeros(100)}, good)
    check_weights(tmp_path)
    data = good.read_bytes()
    for damage in (data[:-1], data[:20], b"", b"\xff" * 64, data[:8] + b"[" + data[9:]):
        good.write_bytes(damage)
        with pytest.raises(OptionError, match="cut off or damaged"):
            check_weights(tmp_path)
    with pytest.raises(OptionError, match="holds no weights"):
        check_weights(tmp_path / "nothing")


def test_presets_choose_and_say_why() -> None:
    assert select("cpu", has_depth=True, profile="any", gpu=None) == ModelSelection(why="preset cpu: nothing to fetch")
    light = select("light", has_depth=False, profile="permissive", gpu=None)
    assert all(c.commercial for _, c in light.cards()) and len(light.cards()) == 4
    assert select("light", has_depth=True, profile="permissive", gpu=None).reconstruction == "auto"
    assert select("paper", has_depth=False, profile="research", gpu=None).reconstruction == "pi3"
    with pytest.raises(OptionError, match="--preset fast is not known"):
        select("fast", has_depth=False, profile="any", gpu=None)


def test_auto_takes_what_is_installed_fetched_and_allowed() -> None:
    nothing = select("auto", has_depth=True, profile="any", gpu=None)
    assert nothing.discovery == "learned" and "no GPU" in nothing.why
    bare = select("auto", has_depth=False, profile="any", gpu=GPU)
    assert (bare.reconstruction, bare.discovery, bare.tracking, bare.features) == (
        "auto",
        "learned",
        "reprojection",
        "geometric",
    )
    assert "pi3 is not installed" in bare.why and "weights not fetched" in bare.why
    put("tue-mps/coco_panoptic_eomt_large_640")
    put("facebook/sam3")
    put("yonigozlan/EdgeTAM-hf")
    some = select("auto", has_depth=True, profile="research", gpu=GPU)
    assert (some.discovery, some.tracking, some.features) == ("eomt", "sam3", "own")
    assert "a GPU" in some.why and "eomt" in some.why
    free = select("auto", has_depth=True, profile="permissive", gpu=GPU)
    assert free.tracking == ("edgetam" if find_spec("timm") else "reprojection"), "its backbone is of another package"
    assert obstacle("sam3", "tracking", "permissive") == "SAM License is not permissive"


def test_weights_words_name_their_part() -> None:
    assert parse_weights(None) == {}
    assert parse_weights(["dir/with=sign", "discovery=a/b@v1"]) == {
        "reconstruction": "dir/with=sign",
        "discovery": "a/b@v1",
    }
    with pytest.raises(OptionError, match="foo is not a part"):
        parse_weights(["foo=x"])
    with pytest.raises(OptionError, match="given twice"):
        parse_weights(["a", "b"])


def test_what_is_forbidden_or_missing_is_refused_before_anything_is_fetched() -> None:
    with pytest.raises(OptionError, match="--tracking sam3: the weights facebook/sam3"):
        check_allowed(ModelSelection(tracking="sam3"), {}, "permissive")
    with pytest.raises(OptionError, match="pi3 needs the package pi3: pip install git"):
        check_allowed(ModelSelection(reconstruction="pi3"), {}, "research")
    assert check_allowed(ModelSelection(), {}, "permissive") == {}
    assert check_allowed(ModelSelection(discovery="eomt"), {}, "permissive") == {
        "discovery": "tue-mps/coco_panoptic_eomt_large_640"
    }
    own = {"discovery": "x/y"}
    assert check_allowed(ModelSelection(discovery="eomt"), own, "research") == own
    with pytest.raises(OptionError, match="x/y are under other"):
        check_allowed(ModelSelection(discovery="eomt"), own, "permissive")


def test_weights_of_a_build_are_named_by_commit(tmp_path: Path) -> None:
    put("tue-mps/coco_panoptic_eomt_large_640")
    named = {"discovery": f"tue-mps/coco_panoptic_eomt_large_640@{COMMIT}"}
    assert pinned_weights(ModelSelection(discovery="eomt"), {}, "permissive") == named
    assert pinned_weights(ModelSelection(), {}, "permissive") == {}
    asked = {"reconstruction": str(tmp_path)}
    assert pinned_weights(ModelSelection("precomputed"), asked, "permissive") == asked


def test_python_builds_video_without_depth_by_default(tmp_path: Path) -> None:
    source = neural_scenes.write_pictures(tmp_path / "pictures", neural_scenes.film())
    for settings in (None, BuildSettings(), BuildSettings(poses="auto")):
        job = prepare(source, None, settings, RunOptions())
        assert (job.settings.reconstruction, job.settings.poses) == ("sfm", "estimate")


def test_python_obeys_the_licence_profile_as_the_commands_do(tmp_path: Path, make_memory: Callable[..., Path]) -> None:
    settings = BuildSettings(discovery="sam3", features="own", device="cpu")
    refused = r"--licence permissive does not allow --discovery sam3.*SAM License"
    with pytest.raises(OptionError, match=refused):
        with_weights(settings, "permissive")
    source = neural_scenes.write_pictures(tmp_path / "pictures", neural_scenes.film())
    with pytest.raises(OptionError, match=refused):
        list3r.build(source, tmp_path / "m.l3r", settings=settings, licence="permissive")
    memory = make_memory()
    with pytest.raises(OptionError, match=refused):
        list3r.update(memory, source, settings=settings, licence="permissive")
    with pytest.raises(OptionError, match=r"--licence permissive does not allow --model siglip2.*see its repository"):
        embed_memory(memory, "someone/else", licence="permissive")
    with pytest.raises(OptionError, match="--licence free is not known"):
        list3r.build(source, tmp_path / "m.l3r", licence="free")
    assert not (tmp_path / "m.l3r").exists()


def test_unknown_names_list_the_known_ones() -> None:
    with pytest.raises(OptionError, match=r"choose one of .*pi3"):
        cards_named("pi4")
    assert {c.part for c in cards_named("sam2")} == {"discovery", "tracking"}


def test_memory_that_runs_out_is_said_in_one_line() -> None:
    from list3r.models.device import out_of_memory_reported

    with pytest.raises(OptionError, match=r"^the tracker does not fit into the GPU memory; .*--device cpu$"):
        with out_of_memory_reported("the tracker"):
            raise torch.OutOfMemoryError("CUDA out of memory")
    with pytest.raises(ValueError, match="other"), out_of_memory_reported("the tracker"):
        raise ValueError("other")


def test_memory_is_that_of_the_weights() -> None:
    card = find_card("da3", "geometry")
    assert card is not None and card.memory is not None
    giant, base = (card.memory_with(f"depth-anything/{name}@{'0' * 40}") for name in ("DA3-GIANT-1.1", "DA3-BASE"))
    assert giant == card.memory_with("a-folder") == card.memory
    assert base is not None and base == card.memory_with(None) and base.fixed_mb < card.memory.fixed_mb / 2


def test_a_package_that_cannot_be_imported_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "broken_package.py").write_text("print('hello')\nraise RuntimeError('operator does not exist')\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    card = find_card("vggt", "geometry")
    assert card is not None
    with pytest.raises(OptionError, match=r"vggt needs broken_package, which cannot be imported here: operator does"):
        upstream_class(card, "broken_package", "VGGT")


def test_the_one_checkpoint_of_an_older_folder_is_read(tmp_path: Path) -> None:
    torch.save(torch.nn.Linear(40, 40).state_dict(), tmp_path / "weights.pt")
    made = load_upstream(lambda: torch.nn.Linear(40, 40), tmp_path, torch.device("cpu"))
    assert torch.equal(made.weight, torch.load(tmp_path / "weights.pt", weights_only=True)["weight"])
    torch.save({"x": torch.zeros(400)}, tmp_path / "more.pt")
    with pytest.raises(OptionError, match="holds 2 checkpoints"):
        load_upstream(lambda: torch.nn.Linear(40, 40), tmp_path, torch.device("cpu"))
