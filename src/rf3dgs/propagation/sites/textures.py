"""Deterministic surface pictures for the built-in lobby: plaster, bricks, planks, tiles, posters, a view outside.

Each function returns sRGB pixels `[row, col, 3]` in [0, 1] of a surface `width` x `height` [m]; `finish` makes bytes.
Splatting needs detail on every surface: no large area is left in one colour.
"""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Pixels = NDArray[np.floating]
Colour = Sequence[float]
DENSITY = 48
"""Pixels per metre."""


def finish(pixels: Pixels) -> NDArray[np.uint8]:
    """Bytes of a picture in [0, 1]."""
    return np.round(np.clip(pixels, 0.0, 1.0) * 255.0).astype(np.uint8)


def noise(rows: int, cols: int, seed: int, *, coarse: float = 24.0, octaves: int = 4) -> Pixels:
    """Smooth noise of mean 0 and deviation 1 that continues across its edges; `coarse` [pixel] is the largest blob."""
    generator = np.random.default_rng(seed)
    total = np.zeros((rows, cols))
    for octave in range(octaves):
        size = max(coarse / 2**octave, 1.0)
        white = np.fft.rfft2(generator.standard_normal((rows, cols)))
        fy = np.fft.fftfreq(rows)[:, None]
        fx = np.fft.rfftfreq(cols)[None]
        smooth = np.fft.irfft2(white * np.exp(-2 * (math.pi * size / 3) ** 2 * (fx**2 + fy**2)), (rows, cols))
        total += smooth / (smooth.std() + 1e-12) / 1.6**octave
    return total / total.std()


def _coordinates(width: float, height: float) -> tuple[Pixels, Pixels]:
    rows, cols = max(round(height * DENSITY), 2), max(round(width * DENSITY), 2)
    x = (np.arange(cols, dtype=np.float64) + 0.5) * (width / cols)
    y = (np.arange(rows, dtype=np.float64) + 0.5) * (height / rows)
    return np.broadcast_to(x, (rows, cols)), np.broadcast_to(y[:, None], (rows, cols))


def _shape(x: Pixels) -> tuple[int, int]:
    return x.shape[0], x.shape[1]


def _paint(colour: Colour, shape: tuple[int, ...]) -> Pixels:
    return np.broadcast_to(np.array(colour, dtype=float), (*shape, 3)).copy()


def speckled(width: float, height: float, colour: Colour, seed: int, *, strength: float = 0.08) -> Pixels:
    """Plaster, stone or fabric: one colour with blobs from a few centimetres to half a metre."""
    x, _ = _coordinates(width, height)
    return _paint(colour, x.shape) * (1 + strength * noise(*_shape(x), seed)[..., None])


def _cells(x: Pixels, y: Pixels, cell: tuple[float, float], seed: int, *, shift: float = 0.0) -> tuple[Pixels, Pixels]:
    """A random number in [0, 1) per cell, and the distance [m] to the cell's edge; odd rows move by `shift` cells."""
    row = np.floor(y / cell[1]).astype(int)
    along = x / cell[0] + shift * (row % 2)
    col = np.floor(along).astype(int)
    table = np.random.default_rng(seed).random((row.max() + 1, col.max() + 1))
    across = np.minimum(along % 1, 1 - along % 1) * cell[0]
    upright = np.minimum(y / cell[1] % 1, 1 - y / cell[1] % 1) * cell[1]
    return table[row, col], np.minimum(across, upright)


def tiles(
    width: float,
    height: float,
    colours: Sequence[Colour],
    cell: tuple[float, float],
    seed: int,
    *,
    joint: Colour,
    shift: float = 0.0,
    gap: float = 0.012,
    strength: float = 0.06,
) -> Pixels:
    """Tiles, bricks, planks or panels: cells [m] of random shade between `colours`, with joints `gap` [m] wide."""
    x, y = _coordinates(width, height)
    shade, edge = _cells(x, y, cell, seed, shift=shift)
    first, second = np.array(colours[0]), np.array(colours[-1])
    picture = first + (second - first) * shade[..., None]
    picture = picture * (1 + strength * noise(*_shape(x), seed + 1, coarse=10)[..., None])
    return np.where((edge < gap)[..., None], np.array(joint), picture)


def grain(width: float, height: float, colour: Colour, seed: int) -> Pixels:
    """Wood with its grain along the surface."""
    x, _ = _coordinates(width, height)
    rows, cols = x.shape
    fine = noise(rows, max(cols // 8, 2), seed, coarse=8)
    stretched = np.repeat(fine, math.ceil(cols / fine.shape[1]), axis=1)[:, :cols]
    return _paint(colour, x.shape) * (1 + 0.16 * stretched[..., None])


def poster(picture: Pixels, width: float, left: float, top: float, size: tuple[float, float], seed: int) -> None:
    """Hang a poster of coloured shapes on a wall's picture (changed in place); measures in [m] from the top left."""
    density = picture.shape[1] / width
    generator = np.random.default_rng(seed)
    x0, y0 = round(left * density), round(top * density)
    cols, rows = round(size[0] * density), round(size[1] * density)
    area = picture[y0 : y0 + rows, x0 : x0 + cols]
    area[:] = 0.12
    inner = area[2:-2, 2:-2]
    inner[:] = 0.35 + 0.6 * generator.random(3)
    v, u = np.meshgrid(np.linspace(0, 1, inner.shape[0]), np.linspace(0, 1, inner.shape[1]), indexing="ij")
    for _ in range(7):
        a, b = generator.random(2)
        radius = 0.08 + 0.2 * generator.random()
        colour = generator.random(3)
        if generator.random() < 0.5:
            inner[np.hypot(u - a, (v - b) * size[1] / size[0]) < radius] = colour
        else:
            inner[(np.abs(u - a) < radius) & (np.abs(v - b) < 0.6 * radius)] = colour


def lettering(width: float, height: float, ground: Colour, ink: Colour, seed: int, *, lines: int) -> Pixels:
    """A sign: rows of blocks that look like words."""
    x, y = _coordinates(width, height)
    picture = _paint(ground, x.shape)
    generator = np.random.default_rng(seed)
    pitch = height / (lines + 0.6)
    for line in range(lines):
        at = 0.08 * width
        top = (line + 0.45) * pitch
        while at < 0.88 * width:
            word = min((0.08 + 0.18 * generator.random()) * width, 0.93 * width - at)
            picture[(x > at) & (x < at + word) & (y > top) & (y < top + 0.6 * pitch)] = ink
            at += word + 0.05 * width
    return picture


def outdoors(width: float, height: float, seed: int) -> Pixels:
    """What is seen through a window: sky, roofs and trees, with the window's bars in front."""
    x, y = _coordinates(width, height)
    v = y / height
    sky = np.array([0.62, 0.78, 0.95]) + (np.array([0.92, 0.95, 0.98]) - np.array([0.62, 0.78, 0.95])) * v[..., None]
    picture = sky * (1 + 0.03 * noise(*_shape(x), seed, coarse=30)[..., None])
    generator = np.random.default_rng(seed + 1)
    at = 0.0
    while at < width:
        broad, roof = 0.25 + 0.5 * generator.random(), 0.35 + 0.3 * generator.random()
        colour = 0.35 + 0.35 * generator.random(3) * np.array([1.0, 0.9, 0.8])
        inside = (x >= at) & (x < at + broad) & (v > roof)
        panes = ((x - at) % 0.14 > 0.06) & (y % 0.16 > 0.07)
        picture[inside] = colour
        picture[inside & panes] = 0.55 * colour
        at += broad
    trees = v > 0.82 + 0.03 * noise(*_shape(x), seed + 2, coarse=14)
    picture[trees] = np.array([0.25, 0.42, 0.20])
    bars = (np.minimum(x, width - x) < 0.05) | (np.minimum(y, height - y) < 0.05) | (np.abs(x - width / 2) < 0.03)
    picture[bars] = np.array([0.25, 0.26, 0.28])
    return picture


def door(width: float, height: float, colour: Colour, seed: int) -> Pixels:
    """A door leaf: wood with two raised panels and a handle."""
    x, y = _coordinates(width, height)
    picture = grain(width, height, colour, seed)
    for low, high in ((0.08, 0.45), (0.55, 0.92)):
        ring = np.maximum(np.abs(x / width - 0.5) / 0.36, np.abs(y / height - (low + high) / 2) / ((high - low) / 2))
        picture[(ring < 1.0) & (ring > 0.9)] *= 0.6
    picture[(np.abs(x - 0.9 * width) < 0.04) & (np.abs(y - 0.52 * height) < 0.12)] = (0.75, 0.72, 0.6)
    return picture


def lift(width: float, height: float, seed: int) -> Pixels:
    """Lift doors: two brushed metal leaves."""
    x, _ = _coordinates(width, height)
    brushed = noise(2, x.shape[1], seed, coarse=6)[:1]
    picture = _paint((0.62, 0.64, 0.67), x.shape) * (1 + 0.10 * brushed[..., None])
    picture[np.abs(x - width / 2) < 0.02] = 0.15
    picture[np.minimum(x, width - x) < 0.05] = 0.3
    return picture
