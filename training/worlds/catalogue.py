"""The kinds of things that worlds are furnished with: 40 families, each kind with its class and where it is put."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from training.worlds import fitted as b
from training.worlds import fixtures as f
from training.worlds import seating as s
from training.worlds import soft, storage, tables
from training.worlds import tabletop as t
from training.worlds.draft import Draft
from training.worlds.oddments import oddment


@dataclass(frozen=True)
class Kind:
    """One parametric kind of thing."""

    name: str
    family: str
    label: str
    """What a person calls it, in one word or two."""
    build: Callable[[Draft], None]
    place: str
    """wall (stands with its back to one), fitted (the same, built in), glazing and panel (on a wall, built in), free,
    fitted free, corner, floor (small things), small (on tops and shelves), desk, media,
    hang (on a wall), ceiling, rug, seat (on seats and beds), shoes, lean."""
    weight: float = 1.0
    """How often it is drawn among the kinds of its place."""


HELD_OUT = ("armchair", "stool", "toy", "luggage", "kettle", "appliance", "stand", "side table", "board", "island")
"""Families that no world for training shows."""

_ROWS: tuple[tuple[str, str, str, Callable[[Draft], None], str, float], ...] = (
    ("sofa", "sofa", "sofa", s.sofa, "wall", 2),
    ("corner sofa", "sofa", "sofa", s.corner_sofa, "wall", 0.7),
    ("armchair", "armchair", "armchair", s.armchair, "corner", 1.5),
    ("slatted chair", "chair", "chair", s.slatted_chair, "free", 2),
    ("padded chair", "chair", "chair", s.padded_chair, "free", 2),
    ("shell chair", "chair", "chair", s.shell_chair, "free", 1.5),
    ("stacked chairs", "chair", "chair", s.folded_chairs, "wall", 0.3),
    ("office chair", "office chair", "chair", s.office_chair, "free", 1.5),
    ("stool", "stool", "stool", s.stool, "free", 1),
    ("bench", "bench", "bench", s.bench, "wall", 0.6),
    ("pouf", "pouf", "pouf", s.pouf, "free", 0.8),
    ("bean bag", "pouf", "pouf", s.beanbag, "corner", 0.4),
    ("dining table", "table", "table", tables.dining_table, "free", 2),
    ("round table", "table", "table", tables.round_table, "free", 1),
    ("bar table", "table", "table", tables.bar_table, "wall", 0.4),
    ("coffee table", "coffee table", "table", tables.coffee_table, "free", 1.5),
    ("side table", "side table", "table", tables.side_table, "corner", 1),
    ("desk", "desk", "desk", tables.desk, "wall", 2),
    ("nightstand", "nightstand", "nightstand", tables.nightstand, "wall", 1),
    ("kitchen counter", "kitchen", "counter", tables.kitchen_counter, "wall", 1),
    ("shelf", "shelf", "shelf", storage.shelf, "wall", 2.5),
    ("frame shelf", "shelf", "shelf", storage.frame_shelf, "wall", 1.2),
    ("cupboard", "cupboard", "cupboard", storage.cupboard, "wall", 1.5),
    ("wardrobe", "cupboard", "wardrobe", storage.wardrobe, "wall", 1),
    ("chest", "chest", "chest of drawers", storage.chest, "wall", 1.2),
    ("media bench", "media bench", "cupboard", storage.media_bench, "wall", 1),
    ("fridge", "appliance", "fridge", storage.fridge, "wall", 0.7),
    ("washer", "appliance", "washing machine", storage.washer, "wall", 0.5),
    ("shoe rack", "shoe rack", "shelf", storage.shoe_rack, "wall", 0.7),
    ("coat stand", "stand", "coat stand", storage.coat_stand, "corner", 0.6),
    ("wall shelf", "wall storage", "shelf", storage.wall_shelf, "hang", 1.2),
    ("wall cupboard", "wall storage", "cupboard", storage.wall_cupboard, "hang", 0.8),
    ("bed", "bed", "bed", soft.bed, "wall", 1.5),
    ("crib", "bed", "bed", soft.crib, "wall", 0.2),
    ("curtain", "curtain", "curtain", soft.curtain, "hang", 1.2),
    ("blind", "curtain", "blind", soft.blind, "hang", 0.5),
    ("rug", "rug", "rug", soft.rug, "rug", 1),
    ("folded cloth", "cloth", "cloth", soft.folded_cloth, "seat", 1),
    ("dropped cloth", "cloth", "cloth", soft.dropped_cloth, "seat", 1),
    ("heap of clothes", "cloth", "cloth", soft.dropped_cloth, "floor", 0.5),
    ("throw", "cloth", "blanket", soft.throw, "seat", 0.7),
    ("towels", "cloth", "cloth", soft.folded_cloth, "small", 0.4),
    ("hanging coat", "clothes", "clothes", soft.hanging_coat, "hang", 0.8),
    ("cushion", "cushion", "cushion", s.cushion, "seat", 1),
    ("handbag", "bag", "bag", soft.handbag, "floor", 0.8),
    ("bag on a seat", "bag", "bag", soft.handbag, "seat", 0.6),
    ("backpack", "bag", "bag", soft.backpack, "floor", 1),
    ("suitcase", "luggage", "suitcase", soft.suitcase, "floor", 0.7),
    ("mug", "mug", "mug", t.mug, "small", 2),
    ("mug on a desk", "mug", "mug", t.mug, "desk", 1.5),
    ("glass", "glass", "glass", t.glass, "small", 0.8),
    ("bowl", "bowl", "bowl", t.bowl, "small", 1.2),
    ("plate", "plate", "plate", t.plate, "small", 0.8),
    ("bottle", "bottle", "bottle", t.bottle, "small", 1.6),
    ("bottle on the floor", "bottle", "bottle", t.bottle, "floor", 0.3),
    ("spray", "bottle", "bottle", t.spray, "small", 0.6),
    ("can", "can", "can", t.can, "small", 1),
    ("jug", "kettle", "jug", t.jug, "small", 0.7),
    ("pot", "pot", "pot", t.pot, "small", 0.7),
    ("vase", "vase", "vase", t.vase, "small", 1),
    ("flowers", "vase", "vase", f.flowers, "small", 0.6),
    ("book", "book", "book", t.book, "small", 2.5),
    ("book on a desk", "book", "book", t.book, "desk", 1.5),
    ("book on a seat", "book", "book", t.book, "seat", 0.7),
    ("open book", "book", "book", t.open_book, "desk", 0.5),
    ("papers", "paper", "paper", t.papers, "desk", 1),
    ("magazine", "paper", "paper", t.papers, "small", 0.6),
    ("carton", "box", "box", t.carton, "small", 2),
    ("carton on the floor", "box", "box", t.carton, "floor", 1.5),
    ("open box", "box", "box", t.open_box, "floor", 1),
    ("open box on a board", "box", "box", t.open_box, "small", 0.4),
    ("basket", "basket", "basket", t.basket, "floor", 1),
    ("block", "toy", "toy", t.toy_blocks, "floor", 0.7),
    ("toy car", "toy", "toy", t.toy_car, "floor", 0.7),
    ("toy on a shelf", "toy", "toy", t.toy_car, "small", 0.5),
    ("soft toy", "toy", "toy", t.soft_toy, "seat", 0.8),
    ("soft toy on a shelf", "toy", "toy", t.soft_toy, "small", 0.4),
    ("ball", "ball", "ball", t.game_ball, "floor", 0.7),
    ("fruit", "fruit", "fruit", t.fruit, "small", 0.6),
    ("shoe", "shoe", "shoe", t.shoe, "shoes", 1),
    ("remote", "device", "remote", t.remote, "small", 0.6),
    ("phone", "device", "remote", t.remote, "desk", 0.6),
    ("gamepad", "device", "gamepad", t.gamepad, "small", 0.3),
    ("tissue box", "box", "box", t.tissue_box, "small", 0.4),
    ("tray", "tray", "tray", t.tray, "small", 0.4),
    ("kitchen roll", "roll", "roll", t.kitchen_roll, "small", 0.5),
    ("statuette", "ornament", "ornament", t.statuette, "small", 0.7),
    ("monitor", "monitor", "monitor", f.monitor, "desk", 0.0),
    ("television", "television", "television", f.television, "media", 1),
    ("wall television", "television", "television", f.wall_television, "hang", 0.5),
    ("keyboard", "keyboard", "keyboard", f.keyboard, "desk", 0.0),
    ("mouse", "keyboard", "mouse", f.mouse, "desk", 0.8),
    ("laptop", "laptop", "laptop", f.laptop, "desk", 1),
    ("computer", "computer", "computer", f.computer, "floor", 0.6),
    ("loudspeaker", "computer", "computer", f.computer, "media", 0.5),
    ("table lamp", "lamp", "lamp", f.table_lamp, "small", 0.8),
    ("desk lamp", "lamp", "lamp", f.desk_lamp, "desk", 0.8),
    ("floor lamp", "lamp", "lamp", f.floor_lamp, "corner", 1),
    ("hanging lamp", "lamp", "lamp", f.hanging_lamp, "ceiling", 1),
    ("picture", "picture", "picture", f.picture, "hang", 3),
    ("photo frame", "picture", "picture", f.photo_frame, "small", 0.6),
    ("mirror", "mirror", "mirror", f.mirror, "hang", 0.5),
    ("clock", "clock", "clock", f.clock, "hang", 0.6),
    ("window", "window", "window", f.window, "hang", 1.5),
    ("door", "door", "door", f.door, "hang", 1.5),
    ("radiator", "radiator", "radiator", f.radiator, "hang", 1.2),
    ("switch", "switch", "switch", f.switch, "hang", 0.4),
    ("plant", "plant", "plant", f.plant, "corner", 1.5),
    ("plant on a board", "plant", "plant", f.plant, "small", 0.6),
    ("cable", "cable", "cable", f.cable, "desk", 0.4),
    ("fan", "fan", "fan", f.fan, "floor", 0.4),
    ("guitar", "guitar", "guitar", f.guitar, "lean", 0.5),
    ("large window", "glazing", "window", b.large_window, "glazing", 2),
    ("folding door", "glazing", "door", b.folding_door, "glazing", 1.5),
    ("sliding door", "glazing", "door", b.sliding_door, "glazing", 1.2),
    ("long curtain", "curtain", "curtain", b.long_curtain, "glazing", 1.2),
    ("lamella blind", "curtain", "blind", b.lamella_blind, "glazing", 0.7),
    ("panel", "panel", "panel", b.panel, "panel", 1.5),
    ("board", "board", "board", b.board, "panel", 1),
    ("large picture", "picture", "picture", b.large_picture, "panel", 1.5),
    ("air conditioner", "air conditioner", "air conditioner", b.air_conditioner, "panel", 0.6),
    ("built-in wardrobe", "built-in", "wardrobe", b.built_in_wardrobe, "fitted", 2),
    ("shelf wall", "built-in", "shelf", b.shelf_wall, "fitted", 0.8),
    ("kitchen run", "kitchen", "counter", b.kitchen_run, "fitted", 2),
    ("island", "island", "counter", b.island, "fitted free", 1),
    ("folding screen", "screen", "screen", b.folding_screen, "fitted free", 0.5),
)

_SMALL = ((0.04, 0.35), (0.04, 0.3), (0.03, 0.4))
_LARGE = ((0.3, 1.8), (0.3, 1.0), (0.3, 2.0))
ODD = {
    place: Kind("oddment", "oddment", "", build, place)
    for place, build in (
        ("small", oddment(_SMALL)),
        ("desk", oddment(_SMALL)),
        ("media", oddment(_SMALL)),
        ("seat", oddment(((0.1, 0.5), (0.1, 0.45), (0.05, 0.4)))),
        ("floor", oddment(((0.08, 0.7), (0.08, 0.6), (0.05, 0.8)))),
        ("wall", oddment(_LARGE)),
        ("corner", oddment(_LARGE)),
        ("free", oddment(((0.4, 1.8), (0.4, 1.2), (0.3, 1.1)))),
        ("hang", oddment(((0.1, 1.4), (0.02, 0.35), (0.1, 1.0)), hung=True)),
        ("panel", oddment(((0.3, 1.8), (0.02, 0.4), (0.3, 1.2)), hung=True)),
        ("ceiling", oddment(((0.2, 0.9), (0.2, 0.9), (0.15, 0.8)), below=True)),
    )
}
"""What no catalogue knows, by place; it has no name."""

KINDS = {row[0]: Kind(*row) for row in _ROWS}
LOOSE = {
    "cushion": "cushion",
    "pillow": "cushion",
    "duvet": "cloth",
    "chair": "chair",
    "cupboard": "wall storage",
    "hood": "hood",
}
"""Family of the things that others bring along, by label."""
BUILT_IN = ("glazing", "panel", "fitted", "fitted free")
"""Places of what is built in."""
STRUCTURE = ("floor", "ceiling", "wall")
LABELS = tuple(sorted({k.label for k in KINDS.values()} | {"pillow", "duvet", "blanket", "hood"}))
FAMILIES = tuple(sorted({k.family for k in KINDS.values()}))


def kinds_at(place: str, *, held_out: bool) -> list[Kind]:
    """Return the kinds that are put at a place; those of left-out families only with `held_out`."""
    return [k for k in KINDS.values() if k.place == place and k.weight > 0 and (held_out or k.family not in HELD_OUT)]
