"""Ask a memory: what is near, what is on what, what is in a place.

python examples/02_ask.py [MEMORY]
"""

import sys

import list3r


def main() -> None:
    with list3r.open(sys.argv[1] if len(sys.argv) > 1 else "out/examples/rooms.l3r") as memory:
        things = memory.instances()
        smallest = min(things, key=lambda thing: float(thing.box.size.prod()))

        print(f"nearest to the {smallest.name} ({smallest.id}), surface to surface:")
        for match in memory.nearest(smallest, k=3):
            print(f"  {match.distance_m:.2f} {memory.units}  {match.instance.name} ({match.instance.id})")

        print("on something:")
        for relation in memory.relations(predicate="on"):
            subject, base = memory[relation.subject], memory[relation.object]
            print(f"  {subject.name} on {base.name}, confidence {relation.confidence:.2f}")

        print("within half a metre of it:")
        for match in memory.within(center=smallest.center, radius=0.5):
            print(f"  {match.instance.name}")


if __name__ == "__main__":
    main()
