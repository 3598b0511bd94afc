"""The list of things beside the scene, as HTML: every name in it is a stranger's."""

from __future__ import annotations

import html
from collections.abc import Iterable, Mapping

from list3r.viewer.world import CHANGE_COLORS, UNCHANGED, ShownWorld

MOST = 60
"""Rows that are shown; further ones are counted."""
CROP_PX = 96
_CLICKED = (
    "const r=event.target.closest('[data-thing]'),f=this.closest('form'),i=f&&f.querySelector('input');if(r&&i){"
    "Object.getOwnPropertyDescriptor(HTMLInputElement.prototype,'value').set.call(i,'#'+r.dataset.thing);"
    "i.dispatchEvent(new Event('input',{bubbles:true}));setTimeout(()=>f.requestSubmit(),120)}"
)
"""A row writes its id into the field of its form, as by hand: viser's HTML has no events. It sends changes of a field
at most every 50 ms, so the form follows later."""
_STYLE = (
    "<style>.things{max-height:38vh;overflow:auto;margin:0 .7em .5em;font-size:.85em;line-height:1.25}"
    ".things button{display:flex;gap:.6em;align-items:center;width:100%;padding:3px;border:0;background:none;"
    "color:inherit;font:inherit;text-align:left;cursor:pointer;border-radius:4px}.things button:hover{background:#8883}"
    ".things img,.things i{width:44px;height:36px;object-fit:cover;border-radius:4px;flex:none;background:#8883}"
    ".things small{opacity:.65;display:block}.legend{margin:0 .9em .5em;font-size:.85em}"
    ".legend i{display:inline-block;width:.9em;height:.9em;border-radius:3px;margin-right:.5em}</style>"
)


def listed(world: ShownWorld, ids: Iterable[int], crops: Mapping[int, str | None], heading: str) -> str:
    """Return the list; `crops` are JPEGs in Base64 by id."""
    rows = []
    for n in ids:
        i, crop = world.instances[n], crops.get(n)
        picture = f'<img alt="" src="data:image/jpeg;base64,{crop}">' if crop else "<i></i>"
        about = i.description if i.description != world.name(n) else ""
        said = f"<span>{html.escape(world.name(n))}<small>{n} &middot; {html.escape(about)}</small></span>"
        rows.append(f'<button type="button" data-thing="{n}">{picture}{said}</button>')
    return (
        f'{_STYLE}<div class="things" onclick="{_CLICKED}"><small>{html.escape(heading)}</small>{"".join(rows)}</div>'
    )


def marked(selected: int | None) -> str:
    """Return what marks the selected row, apart from the list so that it stays where it was scrolled to."""
    return "" if selected is None else f"<style>.things [data-thing='{selected}']{{background:#ffc80059}}</style>"


def filtered(world: ShownWorld, text: str) -> list[int]:
    """Return the ids whose id, name or description has all words of a text; things before structure."""
    words = text.lower().split()
    told = {n: f"{n} {world.name(n)} {i.description}".lower() for n, i in world.instances.items()}
    return [n for n in sorted(told, key=lambda n: (not world.solid(n), n)) if all(w in told[n] for w in words)]


def legend(world: ShownWorld) -> str:
    """Return what the colours of changes mean, and how many there are of each."""
    kinds = [c.event.kind for c in world.changes.values()]
    words = {"added": "added", "moved": "moved; an arrow from where it was", "removed": "removed; a box where it was"}
    rows = [(CHANGE_COLORS[kind], f"{kinds.count(kind)} {said}") for kind, said in words.items()]
    if not any(kind in words for kind in kinds):
        return f'{_STYLE}<div class="legend">Nothing is known to have changed: a change needs two visits.</div>'
    swatch = '<div><i style="background:rgb{}"></i>{}</div>'
    return f'{_STYLE}<div class="legend">{"".join(swatch.format(*r) for r in [*rows, (UNCHANGED, "as it was")])}</div>'
