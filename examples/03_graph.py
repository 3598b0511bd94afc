"""The relations as a networkx graph.

python examples/03_graph.py [MEMORY]
"""

import sys

import networkx

import list3r


def main() -> None:
    with list3r.open(sys.argv[1] if len(sys.argv) > 1 else "out/examples/rooms.l3r") as memory:
        graph = memory.relation_graph()
        print(f"{graph.number_of_nodes()} things, {graph.number_of_edges()} relations")
        supports = networkx.DiGraph((s, o) for s, o, name in graph.edges(keys=True) if name == "on")
        for chain in networkx.weakly_connected_components(supports):
            print("  stands together:", ", ".join(memory.instance(i).description for i in sorted(chain)))


if __name__ == "__main__":
    main()
