"""Reconstruction `ttt3r` (Chen et al., "TTT3R: 3D Reconstruction as Test-Time Training").

The network and the weights of `cut3r`, whose state update is weighted by attention to the picture, so that long videos
are forgotten less. Its package has the class of cut3r with one word more in its configuration.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from list3r.memory.core.errors import OptionError
from list3r.reconstruction.feedforward.network import FeedforwardReconstructor, Network
from list3r.reconstruction.feedforward.pictures import CutSize
from list3r.reconstruction.networks import cut3r
from list3r.reconstruction.registry import ModelOptions

if TYPE_CHECKING:
    import torch


def make(options: ModelOptions) -> FeedforwardReconstructor:
    """Return the model with the weights that the options name."""
    return FeedforwardReconstructor(NETWORK, options)


def load(cls: Any, path: Path, device: torch.device) -> Any:
    """Return the network, its state updated as TTT3R does. Raises `OptionError` for the package of cut3r."""
    if not hasattr(cls, "forward_recurrent_lighter"):  # the mode that cut3r has not
        raise OptionError("ttt3r: the first package dust3r on PYTHONPATH is that of cut3r; put src of TTT3R before it")
    model = cut3r.load(cls, path, device)
    model.config.model_update_type = "ttt3r"
    return model


NETWORK = Network("ttt3r", "dust3r.model", "ARCroco3DStereo", CutSize(longest=512), cut3r.answer, load, half=False)
