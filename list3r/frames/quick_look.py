"""A quick look at how much of a source can be used: some frames, spread over all of it, are read as a build does."""

from __future__ import annotations

from list3r.frames.base import FrameSource

_SPOTS = 24
"""Places of a source that are looked at."""


def unusable(source: FrameSource) -> tuple[str, ...]:
    """Return what is said of frames that cannot be used, as far as a quick look tells; nothing where none was found.

    A video is decoded for some frames from each of its places, another source is read at each of them.
    """
    looked = sorted(source.look(_SPOTS))
    bad = [(number, reason) for number, reason in looked if reason]
    if not bad:
        return ()
    number, reason = bad[0]
    some = "frames" if len(looked) == source.info.frame_count else "frames looked at"
    where = f"the first is frame {number} ({reason})"
    sound = max((k for k, (_, reason) in enumerate(looked) if not reason), default=-1)
    if bad[1:] and looked[sound + 1 :] == bad:
        where = f"all of these from frame {number} on ({reason})"
    elif len(looked) - sound > 2:
        where += f", and all of these from frame {looked[sound + 1][0]} on"
    return (f"{len(bad)} of {len(looked)} {some} cannot be used: {where}",)
