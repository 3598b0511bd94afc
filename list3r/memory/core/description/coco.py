"""The 80 classes of COCO detection in their order (Lin et al., Microsoft COCO, 2014)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

COCO_80 = tuple(
    "person,bicycle,car,motorcycle,airplane,bus,train,truck,boat,traffic light,fire hydrant,stop sign,parking meter,"
    "bench,bird,cat,dog,horse,sheep,cow,elephant,bear,zebra,giraffe,backpack,umbrella,handbag,tie,suitcase,frisbee,"
    "skis,snowboard,sports ball,kite,baseball bat,baseball glove,skateboard,surfboard,tennis racket,bottle,wine glass,"
    "cup,fork,knife,spoon,bowl,banana,apple,sandwich,orange,broccoli,carrot,hot dog,pizza,donut,cake,chair,couch,"
    "potted plant,bed,dining table,toilet,tv,laptop,mouse,remote,keyboard,cell phone,microwave,oven,toaster,sink,"
    "refrigerator,book,clock,vase,scissors,teddy bear,hair drier,toothbrush".split(",")
)

_SIZES = """
person .4 2.1; bicycle .6 2; motorcycle .8 2.6; bench .6 3.5; bird .05 .6; cat .15 .8; dog .15 1.4; backpack .2 .9;
umbrella .2 1.6; handbag .1 .8; tie .2 .8; suitcase .25 1.1; frisbee .15 .4; skis .6 2.2; snowboard .8 2; sports ball
.03 .4; kite .2 2; baseball bat .3 1.1; baseball glove .12 .5; skateboard .3 1.1; surfboard 1 3.2; tennis racket .3
.8; bottle .08 .5; wine glass .07 .35; cup .04 .25; fork .08 .35; knife .08 .5; spoon .08 .4; bowl .07 .5; banana .08
.35; apple .04 .16; sandwich .05 .4; orange .04 .16; broccoli .04 .35; carrot .05 .4; hot dog .08 .35; pizza .12 .6;
donut .05 .25; cake .06 .6; chair .2 1.3; couch .8 4.5; potted plant .08 2.8; bed .8 3; dining table .5 4; toilet .25
1.1; tv .25 2.5; laptop .25 .6; mouse .05 .2; remote .07 .35; keyboard .15 .7; cell phone .07 .25; microwave .25 .9;
oven .3 1.3; toaster .15 .6; sink .2 1.6; refrigerator .35 2.3; book .08 .6; clock .05 1.2; vase .06 1; scissors .07
.4; teddy bear .08 1.4; hair drier .1 .4; toothbrush .08 .35; traffic light .2 1.5; fire hydrant .3 1.3; stop sign .3
1.2; parking meter .3 1.8; airplane 3 80; bus 4 20; train 5 400; truck 3 20; boat 1.5 100; car 2.5 6; horse 1 3; cow 1
3; sheep .6 1.8; elephant 2 8; bear .6 3; zebra 1 3; giraffe 2 6
"""
SIZES_M: dict[str, tuple[float, float]] = {
    " ".join(words[:-2]): (float(words[-2]), float(words[-1])) for words in (part.split() for part in _SIZES.split(";"))
}
"""Least and largest longest edge of things of a class indoors, metres, a part of one (the back of a chair) included."""
BROAD = frozenset(("dining table", "bed", "couch", "bench"))
"""Classes that are broad both ways as one looks down on them."""
_BROAD_M = 0.25
THICKEST_M = {"book": 0.07, "cell phone": 0.04, "keyboard": 0.08, "remote": 0.07, "pizza": 0.08, "tv": 0.3}
"""Largest shortest edge of things that are flat, metres, with two centimetres for the noise of depth."""


def plausible(name: str, size_m: NDArray[np.float64]) -> bool:
    """Whether a thing of this size can be of a class: what is far off (a cup of a metre) is another thing.

    `size_m` are the full edges of its box, the third one upright, metres. Shape (3,).
    """
    low, high = SIZES_M.get(name, (0.0, np.inf))
    fits = low <= float(size_m.max()) <= high
    flat = float(size_m.min()) <= THICKEST_M.get(name, np.inf)
    return fits and flat and (name not in BROAD or float(size_m[:2].min()) >= _BROAD_M)
