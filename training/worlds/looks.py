"""Looks that a palette of clean materials lacks: wear and prints of all scales, gloss that shows the room, exposure.

Depth from pictures must not take what a glossy front shows for a place behind it (research/colour-video 0198).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from training.worlds.render import Floats, Hits, Painter, Picture, Renderer

_TEXTURE_PX, _TEXTURES = 256, 4


class WornPainter:
    """Multiplies what another painter says by noise of all scales, on some of the meshes."""

    def __init__(self, inner: Painter, meshes: int, rng: np.random.Generator) -> None:
        self._inner = inner
        self._images = np.stack([_pink(rng) for _ in range(_TEXTURES)])
        share = 0.7 if rng.random() < 0.5 else 0.3
        self._amount = np.where(rng.random(meshes) < share, rng.uniform(0.03, 0.45, meshes), 0.0).astype(np.float32)
        self._size_m = np.exp(rng.uniform(np.log(0.25), np.log(2.5), meshes)).astype(np.float32)
        self._which = rng.integers(0, _TEXTURES, meshes)
        self._tint = rng.normal(0.0, 0.4, (meshes, 3)).astype(np.float32)

    def color(self, hit: Hits) -> tuple[Floats, Floats]:
        """Return RGB in [0, 255] (N, 3) and the share of failing depth (N,)."""
        albedo, failing = self._inner.color(hit)
        rows = np.flatnonzero(self._amount[hit.mesh] > 0)
        mesh = hit.mesh[rows]
        noise = self._noise(mesh, hit.points[rows], hit.normals[rows])
        stronger = self._amount[mesh][:, None] * noise[:, None] * (1.0 + self._tint[mesh])
        out = albedo.copy()
        out[rows] *= np.exp(stronger).astype(np.float32)
        return out, failing

    def _noise(self, mesh: NDArray[np.int64], points: Floats, normals: Floats) -> Floats:
        """Texture across the axis that a surface faces most. Shape (N,)."""
        axis = np.abs(normals).argmax(axis=1)
        place = points / self._size_m[mesh][:, None]
        x = np.where(axis == 0, place[:, 1], place[:, 0]) % 1.0 * _TEXTURE_PX
        y = np.where(axis == 2, place[:, 1], place[:, 2]) % 1.0 * _TEXTURE_PX
        i, j, image = x.astype(int) % _TEXTURE_PX, y.astype(int) % _TEXTURE_PX, self._which[mesh]
        k, m = (i + 1) % _TEXTURE_PX, (j + 1) % _TEXTURE_PX
        fx, fy = x - np.floor(x), y - np.floor(y)
        above = self._images[image, i, j] * (1 - fx) + self._images[image, k, j] * fx
        below = self._images[image, i, m] * (1 - fx) + self._images[image, k, m] * fx
        return np.asarray(above * (1 - fy) + below * fy, np.float32)


def _pink(rng: np.random.Generator) -> Floats:
    """Periodic noise of unit deviation whose waves are the stronger the longer they are."""
    f = np.fft.fftfreq(_TEXTURE_PX)
    length = np.sqrt(f[:, None] ** 2 + f[None] ** 2)
    length[0, 0] = 1.0
    white = np.fft.fft2(rng.standard_normal((_TEXTURE_PX, _TEXTURE_PX)))
    image = np.fft.ifft2(white / length ** rng.uniform(0.6, 1.4)).real
    return np.asarray((image - image.mean()) / image.std(), np.float32)


@dataclass(frozen=True)
class Gloss:
    """How surfaces mirror the room."""

    share: Floats
    """What of the light each mesh mirrors when looked at straight; more from the side. Shape (M,)."""
    blur_px: float
    """How rough surfaces are."""
    highlight: float
    """Brightness of the lamp's own picture, grey levels."""
    power: float
    """The larger, the smaller that picture is."""

    @staticmethod
    def draw(meshes: int, rng: np.random.Generator) -> Gloss:
        """Draw the gloss of a room."""
        glossy = rng.random(meshes) < rng.choice([0.1, 0.3, 0.6])
        share = np.where(glossy, rng.uniform(0.02, 0.4, meshes) ** 1.3, 0.0).astype(np.float32)
        blur, power = float(rng.choice([0.0, 1.5, 4.0, 8.0])), float(np.exp(rng.uniform(np.log(10), np.log(300))))
        return Gloss(share, blur, float(rng.uniform(0.0, 150.0)), power)


class GlossyRenderer(Renderer):
    """Pictures in which glossy things mirror what is around them."""

    def __init__(self, plain: Renderer, gloss: Gloss) -> None:
        super().__init__(plain.caster, plain.painter, plain.owner, plain.light, plain.camera)
        self._gloss = gloss

    def render(self, T_world_cam: NDArray[np.float64]) -> Picture:
        """Return what the camera at a pose (4, 4) sees."""
        picture = super().render(T_world_cam)
        origin = T_world_cam[:3, 3].astype(np.float32)
        rays = self.rays @ T_world_cam[:3, :3].T.astype(np.float32)
        hits, known, _ = self.caster.cast(origin, rays)
        straight = self._gloss.share[hits.mesh]
        glossy = straight > 0
        if not glossy.any():
            return picture
        rows = np.flatnonzero(known)[glossy]
        points, normals = hits.points[glossy], hits.normals[glossy]
        looking = rays[rows] / np.linalg.norm(rays[rows], axis=1, keepdims=True)
        facing = (looking * normals).sum(axis=1, keepdims=True)
        mirrored = (looking - 2.0 * facing * normals).astype(np.float32)
        grazing = (1.0 - np.abs(facing[:, 0])) ** 5  # Schlick 1994
        share = straight[glossy] + (1.0 - straight[glossy]) * 0.6 * grazing
        shape = picture.depth.shape
        seen, weight = np.zeros((*shape, 3), np.float32), np.zeros(shape, np.float32)
        light = self._mirrored(points, normals, mirrored) + self._lamp(points, mirrored)
        seen.reshape(-1, 3)[rows] = light * share[:, None]
        weight.reshape(-1)[rows] = share
        color = picture.color * (1.0 - weight[..., None]) + self._blurred(seen, weight > 0)
        kept = np.clip(color, 0.0, 255.0).astype(np.float32)
        return Picture(kept, picture.depth, picture.ids, picture.cosine, picture.glass)

    def _mirrored(self, points: Floats, normals: Floats, rays: Floats) -> Floats:
        """Colour of what rays from points meet. Shape (N, 3)."""
        out = np.zeros((len(points), 3), np.float32)
        hits, known, _ = self.caster.cast((points + 0.003 * normals).astype(np.float32), rays)
        albedo, _ = self.painter.color(hits)
        out[known] = self.lit(albedo, hits, shadows=False)
        return out

    def _lamp(self, points: Floats, rays: Floats) -> Floats:
        """Brightness of the lamp in the mirror. Shape (N, 1)."""
        to_lamp = self.light.position - points
        to_lamp = to_lamp / np.linalg.norm(to_lamp, axis=1, keepdims=True)
        along = np.clip((to_lamp * rays).sum(axis=1, keepdims=True), 0.0, 1.0)
        return np.asarray(self._gloss.highlight * along**self._gloss.power, np.float32)

    def _blurred(self, seen: Floats, inside: NDArray[np.bool_]) -> Floats:
        """What is mirrored, blurred within the glossy surfaces. Shape (H, W, 3)."""
        if self._gloss.blur_px == 0.0:
            return seen
        size = (0, 0)
        near = cv2.GaussianBlur(inside.astype(np.float32), size, self._gloss.blur_px)
        blurred = cv2.GaussianBlur(seen, size, self._gloss.blur_px)
        return np.asarray(blurred / np.maximum(near, 1e-3)[..., None] * inside[..., None], np.float32)


def with_looks(plain: Renderer, seed: int) -> Renderer:
    """Return the renderer of a room whose surfaces are worn, printed and glossy."""
    rng, meshes = np.random.default_rng([seed, 55]), len(plain.owner)
    worn = Renderer(plain.caster, WornPainter(plain.painter, meshes, rng), plain.owner, plain.light, plain.camera)
    return GlossyRenderer(worn, Gloss.draw(meshes, rng))


def exposed(color: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.uint8]:
    """Return frames (F, H, W, 3) darker towards their corners, with exposure and white balance that change."""
    count, height, width = color.shape[:3]
    y, x = np.mgrid[:height, :width]
    far = ((x - width / 2) ** 2 + (y - height / 2) ** 2) / (width * width / 4 + height * height / 4)
    shadow = 1.0 - rng.uniform(0.0, 0.35) * far
    gain = np.exp(rng.normal(0.0, 0.06, (count, 1)) + rng.normal(0.0, 0.02, (count, 3)))
    return np.stack(
        [np.clip(c * shadow[..., None] * g, 0, 255).astype(np.uint8) for c, g in zip(color, gain, strict=True)]
    )
