"""Rules, the graph with and without votes, the votes alone and the truth on walks that nothing was trained on.

PYTHONPATH=.:benchmarks python -m training.pictures.compare --run DIR --network DIR --seeds 6001-6010 --json FILE
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import discovery
import numpy as np
import torch

from list3r.instances.learned import discovery as learned
from list3r.instances.learned.agglomeration import agglomerate
from list3r.instances.learned.cut import CloudCut, CutSettings, cut_cloud, make_parts
from list3r.instances.learned.graph import ChunkSurface
from list3r.instances.learned.network import Weights, judge
from list3r.instances.learned.pieces import Pieces, cut_pieces
from list3r.instances.learned.things import ThingVerdicts, judge_things
from training.pictures.fit import APART
from training.pictures.network import PictureNetwork
from training.pictures.votes import NODE_VOTES, read_network, say, vote_graph, with_votes

Cut = Callable[[ChunkSurface, Weights, CutSettings | None], CloudCut]
LEAST_VOXELS = 80
"""Clusters of votes alone are listed from this size; nothing judges them."""
SPENT = {"say": 0.0, "votes": 0.0, "views": 0}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--run", type=Path, required=True, help="folder of `training.pictures.bakeoff`")
    parser.add_argument("--network", type=Path, required=True)
    parser.add_argument("--seeds", default="6001-6010")
    parser.add_argument("--house", type=Path)
    parser.add_argument("--methods", default="geometric,shipped,a,b,c,true")
    parser.add_argument("--json", type=Path, required=True)
    words = parser.parse_args()
    torch.set_num_threads(1)
    network = read_network(words.network)
    rows = [json.loads(line) for line in words.json.read_text().splitlines()] if words.json.exists() else []
    done = {(r["seed"], r["method"]) for r in rows}
    methods = words.methods.split(",")
    for seed in discovery.seeds_of(words.seeds):
        if all((seed, m) in done for m in methods):
            continue
        film = discovery.film_of(seed, None, words.house)
        for method in methods:
            if (seed, method) in done:
                continue
            weights = words.run / method[0] / "weights.npz" if method in ("a", "c", "c long") else None
            learned.cut_cloud = _cut_of(method[0], network)
            used = method if method in ("geometric", "true") else "learned"
            row = {"method": method, "seed": seed, "sensor": film[0].sensor}
            row |= discovery.judge(film, seed, used, weights)
            rows.append(row)
            with words.json.open("a") as out:
                out.write(json.dumps(row) + "\n")
    for method in methods:
        mine = [r for r in rows if r["method"] == method]
        print(method, json.dumps(discovery.summary(mine)), flush=True)  # noqa: T201
    print(SPENT)  # noqa: T201


def _cut_of(method: str, network: PictureNetwork) -> Cut:
    if method == "c":
        return lambda surface, weights, s=None: _voted(surface, weights, s or CutSettings(), network)
    if method == "b":
        return lambda surface, weights, s=None: _alone(surface, weights, network)
    return cut_cloud


def _said(surface: ChunkSurface, network: PictureNetwork) -> Any:
    began = time.process_time()
    said = say([network], surface)
    SPENT["say"] += time.process_time() - began
    SPENT["views"] += len(surface.views)
    return said


def _voted(surface: ChunkSurface, weights: Weights, s: CutSettings, network: PictureNetwork) -> CloudCut:
    pieces, said = cut_pieces(surface), _said(surface, network)
    began = time.process_time()
    graph = with_votes(surface, pieces.labels, pieces.graph, said)
    SPENT["votes"] += time.process_time() - began
    parts, coarse = make_parts(surface, Pieces(pieces.labels, graph), judge(weights, "fine", graph), s.sure)
    coarse = with_votes(surface, parts, coarse, said)
    told = judge(weights, "coarse", coarse)
    own = agglomerate(len(coarse.nodes), coarse.left, coarse.right, told.affinity, coarse.weight, s.enough)
    labels = np.asarray(np.append(own, -1)[parts], np.int32)
    return CloudCut(labels, judge_things(weights, own, coarse, told))


def _alone(surface: ChunkSurface, weights: Weights, network: PictureNetwork) -> CloudCut:
    pieces, said = cut_pieces(surface), _said(surface, network)
    g = with_votes(surface, pieces.labels, pieces.graph, said)
    own = agglomerate(len(g.nodes), *vote_graph(surface, pieces.labels, said, APART), 0.0)
    size = g.moments[:, 0].astype(np.float64)
    total = np.bincount(own, size)
    flat = np.bincount(own, size * np.clip(g.nodes[:, -NODE_VOTES], -6, 6)) / total
    structure = (1 / (1 + np.exp(-flat))).astype(np.float32)
    whole = np.where(total >= LEAST_VOXELS, 0.9, 0.0).astype(np.float32)
    names = np.zeros((len(total), len(weights["names"])), np.float32)
    labels = np.asarray(np.append(own, -1)[pieces.labels], np.int32)
    return CloudCut(labels, ThingVerdicts(structure, whole, names))


if __name__ == "__main__":
    main()
