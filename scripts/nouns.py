"""Make the table of nouns that names are looked up in, from a table written by hand and WordNet 3.0.

    apt-get download wordnet-base && dpkg -x wordnet-base*.deb wordnet
    python scripts/nouns.py wordnet/usr/share/wordnet

`scripts/nouns.psv` is written by hand: names, what they are kinds of, sizes, uses and translations. WordNet adds
synonyms (the other words of a name's synset) and broader names (its nearest hypernyms that are names of the table).
"""

from __future__ import annotations

import argparse
import csv
from pathlib import Path

HAND = Path(__file__).with_name("nouns.psv")
OUT = Path(__file__).parent.parent / "list3r/memory/core/description/nouns.tsv"
_LEXICAL_FILES = {"05", "06", "10", "13", "18", "20"}
"""Animals, artifacts, what is read, food, persons, plants."""
_NOT_MEANT = frozenset(
    "puff,sack,press,contraption,contrivance,convenience,line,transmission line,host,reamer,yield,murphy,staff of life,"
    "patty,sinker,red hot,material,shock,shock absorber,mantle,pall,wear,lid,band,grip,lumber,mitt,club,hobby,tape,"
    "asphyxiator,letter paper,volume,icon,ikon,bathroom,essence,coffin nail,butt,fag,base,bay,cell,golem,warmer,pass,"
    "idiot box,boob tube,stereophony,data processor,voider,circular file,spread,counterpane,plug,pusher,stump,ambo,"
    "duplicator,tympan,membranophone,vesture,habiliment,spud,tater".split(",")
)
"""What few people call these things, or say of other things."""
_OTHER_SENSE = frozenset("plate,sponge,rag,plant,pipe,scooter,bus,hose,aquarium,notebook".split(","))
"""Names whose sense in WordNet would be another one."""
_NOT_A = frozenset(
    "headboard<panel,counter<table,sideboard<board,easel<tripod,floor lamp<furniture,table lamp<furniture,kettle<pot,"
    "ironing board<board,cutting board<board,skateboard<board,snowboard<board,surfboard<board,jug<bottle,vase<jar,"
    "toolbox<chest,ladle<vessel,spatula<cookware,boiler<vessel,candle<lamp,light bulb<lamp,balloon<vehicle,"
    "ladder<stairs,bidet<basin,bathtub<vessel,socket<container,sock<hose,sleeping bag<bag,trivet<pedestal,"
    "skirting board<decoration,vent<opening,paper towel<towel,hair dryer<dryer,jewelry<decoration,cereal box<box,"
    "pencil case<box,mailbox<box,dustpan<container,toothbrush<brush,jacket<coat".split(",")
)
"""Kinds of things that are so in WordNet only."""


class WordNet:
    """The nouns of WordNet: synsets by their offset."""

    def __init__(self, folder: Path) -> None:
        self.words: dict[str, list[str]] = {}
        self.hypernyms: dict[str, list[str]] = {}
        self.lexical_file: dict[str, str] = {}
        self.senses: dict[str, list[str]] = {}
        for line in (folder / "data.noun").read_text().splitlines():
            if line.startswith("  "):
                continue  # the licence
            offset, lexical_file, _, count, *rest = line.split("|")[0].split()
            n = int(count, 16)
            self.lexical_file[offset] = lexical_file
            self.words[offset] = [w.replace("_", " ") for w in rest[0 : 2 * n : 2]]
            pointers = rest[2 * n + 1 :]
            self.hypernyms[offset] = [pointers[k + 1] for k in range(0, len(pointers), 4) if pointers[k] == "@"]
        for line in (folder / "index.noun").read_text().splitlines():
            if not line.startswith("  "):
                lemma, _, count, *rest = line.split()
                self.senses[lemma.replace("_", " ")] = rest[-int(count) :]

    def above(self, offset: str) -> list[str]:
        """Return all hypernyms, the nearest first."""
        out, level = [], self.hypernyms[offset]
        while level:
            out += level
            level = [h for o in level for h in self.hypernyms[o] if h not in out]
        return list(dict.fromkeys(out))

    def sense(self, name: str, broader: list[str]) -> str | None:
        """Return the synset that a name means: one below what it is a kind of, else the first of a kind of thing."""
        found = [s for s in self.senses.get(name, ()) if self.lexical_file[s] in _LEXICAL_FILES]
        below = [s for s in found if any(set(self.words[h]) & set(broader) for h in self.above(s))]
        artifacts = [s for s in found if self.lexical_file[s] == "06"]
        return next(iter([*below, *artifacts, *found]), None)


def main() -> None:
    """Read, join and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("wordnet", type=Path, help="folder with data.noun and index.noun")
    wordnet = WordNet(parser.parse_args().wordnet)
    with HAND.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file, delimiter="|", quoting=csv.QUOTE_NONE))
    taken = {w for r in rows for w in [r["name"], *r["synonyms"].split(",")]}
    meant = [r for r in rows if r["name"] not in _OTHER_SENSE]
    sense = {r["name"]: wordnet.sense(r["name"], r["broader"].split(",")) for r in meant}
    name_of = {s: name for name, s in sense.items() if s is not None}
    kinds = {r["name"]: [b for b in r["broader"].split(",") if b] for r in rows}
    for row in rows:
        own = sense.get(row["name"])
        if own is None:
            continue
        more = [w for w in wordnet.words[own] if w not in taken and w not in _NOT_MEANT and w.islower()]
        taken.update(more)
        row["synonyms"] = ",".join([s for s in [*row["synonyms"].split(","), *more] if s])
        above = next((name_of[h] for h in wordnet.above(own) if h in name_of), None)
        known = _above(row["name"], kinds)
        if above and above not in known and row["name"] not in _above(above, kinds) | {above}:
            if f"{row['name']}<{above}" not in _NOT_A:
                kinds[row["name"]].append(above)
                print(f"{row['name']} < {above}")
        if more:
            print(f"{row['name']} = {', '.join(more)}")
        row["broader"] = ",".join(kinds[row["name"]])
    with OUT.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]), delimiter="\t", quoting=csv.QUOTE_NONE, lineterminator="\n")
        writer.writeheader()
        writer.writerows(sorted(rows, key=lambda r: r["name"]))


def _above(name: str, kinds: dict[str, list[str]]) -> set[str]:
    """Return all that a name is a kind of."""
    return {b for k in kinds[name] for b in {k, *_above(k, kinds)}}


if __name__ == "__main__":
    main()
