"""Pictures as bytes of a file."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

JPEG_QUALITY = 95


def jpeg(color: NDArray[np.uint8]) -> bytes:
    """Return an RGB picture (H, W, 3) as JPEG."""
    done, data = cv2.imencode(".jpg", cv2.cvtColor(color, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    assert done
    return data.tobytes()


def png16(depth: NDArray[np.float32], units_per_m: float) -> bytes:
    """Return depth (H, W), metres, as PNG of 16 bits; what does not fit is unknown."""
    stored = np.rint(depth * units_per_m)
    stored[(stored < 0) | (stored > np.iinfo(np.uint16).max)] = 0
    done, data = cv2.imencode(".png", stored.astype(np.uint16), [cv2.IMWRITE_PNG_COMPRESSION, 3])
    assert done
    return data.tobytes()
