"""Words and pictures in one space: real architectures with small random weights, the real memory and program."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("transformers")

import list3r
from list3r.cli.app import run
from list3r.memory.core.errors import OptionError
from list3r.memory.store.store import Store
from list3r.queries.find import find
from list3r.queries.finding.free_words import named_by_vectors
from list3r.queries.nearest import nearest
from list3r.semantics.embedding import StoredTextModel, embed_memory, stored_text_model
from list3r.semantics.text_image import TextImageModel, square_crop
from tests.neural_models import save_text_image


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    base = tmp_path_factory.mktemp("text")
    return {kind: save_text_image(kind, base / kind) for kind in ("clip", "siglip")}


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A walk of a few frames, built by the program."""
    from list3r.simulation.dataset import WalkSettings, write_walk

    base = tmp_path_factory.mktemp("walk")
    write_walk(base / "walk", WalkSettings(seed=3, frames=10, size=(160, 120)))
    path = base / "m.l3r"
    assert run(["build", str(base / "walk"), "-m", str(path), "--workers", "0", "--json"]) == 0
    return path


@pytest.fixture
def memory(built: Path, tmp_path: Path) -> Path:
    return Path(shutil.copy(built, tmp_path / "m.l3r"))


@pytest.mark.parametrize("kind", ["clip", "siglip"])
def test_words_and_pictures_share_a_space(kind: str, weights: dict[str, Path]) -> None:
    model = TextImageModel(weights[kind], "cpu")
    word = model.encode("red mug")
    pictures = model.encode_pictures([np.full((20, 30, 3), 200, np.uint8), np.zeros((64, 10, 3), np.uint8)])
    assert pictures.shape == (2, *word.shape)
    np.testing.assert_allclose(np.linalg.norm(pictures, axis=1), 1.0, rtol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(word), 1.0, rtol=1e-5)
    assert (model.encode("chair") != word).any()
    np.testing.assert_array_equal(model.encode("red mug"), word)
    assert model.space.startswith(f"{kind}@")


def test_other_networks_are_refused(tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text(json.dumps({"model_type": "bert"}))
    with pytest.raises(OptionError, match="bert"):
        TextImageModel(tmp_path)


def test_crops_are_square_and_grey_beyond_the_border() -> None:
    picture = np.zeros((50, 80, 3), np.uint8)
    crop = square_crop(picture, (-10, 0, 20, 10))
    assert crop.shape[0] == crop.shape[1] >= 30
    assert (crop[:, 0] == 127).all() and (crop == 0).any()
    far = square_crop(picture, (200, 200, 220, 220))
    assert (far == 127).all()


def test_embedding_a_memory_lets_free_words_find(memory: Path, weights: dict[str, Path]) -> None:
    report = embed_memory(memory, str(weights["clip"]), "cpu")
    assert report.instances > 0
    with Store.open(memory) as store:
        words = stored_text_model(store)
        assert words is not None and words.space == report.space
        ids, vectors = store.embeddings.all(report.space)
        assert len(ids) == report.instances
        np.testing.assert_allclose(np.linalg.norm(vectors, axis=1), 1.0, rtol=1e-4)

        class Chosen(StoredTextModel):
            """The same words, with a bar that random weights can pass."""

            min_cosine = -1.0

        eager = Chosen(words.space, str(weights["clip"]), "cpu")
        cosine = named_by_vectors(store, eager, "mug")
        assert sorted(cosine) == sorted(ids.tolist())
        answers = nearest(store, words="zebra", k=3, encoder=eager)
        assert len(answers) == 3 and all("cosine" in a.reason for a in answers)
        assert [a.score for a in answers] == sorted((a.score for a in answers), reverse=True)
        assert find(store, "zebra", 3, encoder=eager)
    assert run(["verify", str(memory)]) == 0


def test_the_program_embeds_and_answers(
    memory: Path, weights: dict[str, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    capsys.readouterr()
    options = ["--model", "clip", "--weights", str(weights["clip"]), "--device", "cpu", "--json"]
    assert run(["embed", str(memory), *options]) == 0
    assert json.loads(capsys.readouterr().out)["matches"][0]["instances"] > 0
    assert run(["find", str(memory), "zebra", "--json"]) == 0
    json.loads(capsys.readouterr().out)
    with list3r.open(memory) as scene:
        scene.nearest("zebra", k=2)
    assert run(["embed", str(memory), "--model", "magic"]) == 2
    assert run(["embed", str(memory), "--weights", str(memory.parent / "none")]) == 2


def test_weights_that_went_away_are_a_note(memory: Path, tmp_path: Path) -> None:
    folder = save_text_image("siglip", tmp_path / "w")
    embed_memory(memory, str(folder), "cpu")
    (folder / "model.safetensors").unlink()
    with Store.open(memory) as store:
        found = find(store, "zebra", encoder=stored_text_model(store))
        assert not found and any("cannot be compared" in note for note in found.notes)
        assert nearest(store, words="zebra", encoder=stored_text_model(store)) == []
