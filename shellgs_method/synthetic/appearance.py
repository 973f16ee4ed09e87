"""Materials and light: weakly textured plaster, glass that reflects the street, an overcast day with a little sun.

All colours are linear; :func:`developed` applies the display gamma last.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from jaxtyping import Float, Float64, UInt8
from scipy.ndimage import gaussian_filter1d, map_coordinates

from shellgs_method.geometry.camera import Camera, world_rays
from shellgs_method.synthetic.building import BAY, STOREY
from shellgs_method.synthetic.geometry import Material
from shellgs_method.synthetic.street import CAR, HOUSE, KERB
from shellgs_method.synthetic.world import Frames, World

SUN = np.array([-0.42, -0.55, 0.72], dtype=np.float32)
_SUNLIGHT = np.array([0.42, 0.39, 0.34], dtype=np.float32)
_SKYLIGHT = np.array([0.66, 0.70, 0.76], dtype=np.float32)
_GROUNDLIGHT = np.array([0.42, 0.40, 0.37], dtype=np.float32)

_REFLECTANCE = 0.32
"""Reflectance of sun-protection glazing at normal incidence; bare glass has 0.04 per surface."""

STOPS, BALANCE = 0.7, 0.08
"""Largest change of exposure in stops, and of red and blue against green."""
JUMPS = 3


@dataclass(frozen=True)
class Daylight:
    """A lit world.

    Attributes:
        world: geometry and materials.
        lattice: random numbers in [-1, 1], interpolated to the noise of all textures.
    """

    world: World
    lattice: Float[np.ndarray, "S S"]

    def radiance(
        self, origins: Float[np.ndarray, "*N 3"], directions: Float[np.ndarray, "N 3"], bounces: int = 1
    ) -> Float[np.ndarray, "N 3"]:
        """Radiance seen along the rays; panes reflect up to ``bounces`` times."""
        directions = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
        hits = self.world.cast(origins, directions)
        colour = np.empty_like(directions)
        missed = np.isinf(hits.t)
        colour[missed] = self._sky(directions[missed])
        hit = np.flatnonzero(~missed)
        material, normal, towards = self.world.material[hits.triangle[hit]], hits.normal[hit], directions[hit]
        points = np.broadcast_to(origins, directions.shape)[hit] + hits.t[hit, None] * towards
        frames = self.world.frames(hits.triangle[hit])
        local = frames.points(points)
        albedo = frames.tint * self._albedo(material, local)
        colour[hit] = albedo * self._irradiance(points, normal, recess=np.clip(local[:, 1:2], 0.0, 0.25))

        pane = material == Material.GLASS
        if pane.any() and bounces:
            colour[hit[pane]] = self._glass(points[pane], normal[pane], towards[pane], frames[pane], bounces - 1)
        return colour

    def _albedo(self, material: np.ndarray, points: np.ndarray) -> np.ndarray:
        albedo = np.zeros_like(points)
        for kind in np.unique(material):
            chosen = material == kind
            albedo[chosen] = _ALBEDO[Material(kind)](points[chosen], self._noise)
        return albedo

    def _irradiance(self, points: np.ndarray, normal: np.ndarray, recess: np.ndarray) -> np.ndarray:
        sun = SUN / np.linalg.norm(SUN)
        cosine = np.maximum(normal @ sun, 0.0)
        cosine[self.world.blocked(points + 1e-3 * normal, sun)] = 0.0
        up = 0.5 + 0.5 * normal[:, 2:]
        ambient = up * _SKYLIGHT + (1 - up) * _GROUNDLIGHT
        # Recesses get less skylight.
        ambient = ambient * (1.0 - 1.4 * recess)
        return ambient + cosine[:, None] * _SUNLIGHT

    def _glass(
        self, points: np.ndarray, normal: np.ndarray, towards: np.ndarray, frames: Frames, bounces: int
    ) -> np.ndarray:
        """Mix the room behind a pane and the reflected street by Schlick's approximation of Fresnel's law."""
        local = frames.points(points)
        x, z = local[:, 0], local[:, 2]
        # Real casements are not quite parallel, nor panes quite flat; only the shading has this, not the geometry.
        tilt = np.stack([self._random(2 * x / BAY, z / STOREY, k) for k in range(2)], axis=-1)
        bow = np.stack([self._noise(x, z, 0.5), self._noise(z, x, 0.5)], axis=-1)
        optical = frames.inwards(normal)
        optical[:, [0, 2]] += 0.012 * tilt + 0.004 * bow
        optical = frames.outwards(optical)
        optical /= np.linalg.norm(optical, axis=-1, keepdims=True)

        cosine = np.sum(optical * towards, axis=-1, keepdims=True)
        fresnel = _REFLECTANCE + (1 - _REFLECTANCE) * (1 - np.abs(cosine)) ** 5
        mirrored = towards - 2 * cosine * optical
        return (1 - fresnel) * self._room(local, frames.inwards(towards)) + fresnel * self.radiance(
            points + 1e-3 * normal, mirrored, bounces
        )

    def _room(self, points: np.ndarray, towards: np.ndarray) -> np.ndarray:
        """A dark room with curtains and a blind just behind the pane, different for each window."""
        bay, storey = points[:, 0] / BAY, points[:, 2] / STOREY
        random = partial(self._random, bay, storey)
        hung = points + 0.3 * towards / np.maximum(towards[:, 1:2], 0.2)
        x, z = hung[:, 0] / BAY - np.floor(bay) - 0.5, hung[:, 2] / STOREY - np.floor(storey)

        cloth = 0.24 + 0.03 * np.sin(hung[:, 0] * 55.0) + 0.1 * random(2)
        cloth *= 1 + 0.4 * self._noise(hung[:, 0], hung[:, 2], 0.12)
        slats = 0.3 + 0.06 * np.sin(hung[:, 2] * 120.0) + 0.1 * random(3)
        depth = 0.035 + 0.02 * np.sin(hung[:, 2] * 1.9)
        drawn = (x < -0.17 + 0.12 * random(4)) | (x > 0.17 + 0.12 * random(5))
        lowered = z > 0.7 + 0.2 * random(6)
        tint = np.array([1.0, 0.95, 0.88]) + 0.12 * np.stack([random(7), 0 * bay, random(8)], axis=-1)
        return np.where(drawn, cloth, np.where(lowered, slats, depth))[:, None] * tint

    def _random(self, u: np.ndarray, v: np.ndarray, k: int) -> np.ndarray:
        """The ``k``-th random number in [-1, 1] of the unit cell around (u, v)."""
        size = len(self.lattice)
        return self.lattice[(np.floor(u).astype(int) + 31 * k) % size, (np.floor(v).astype(int) + 17 * k) % size]

    def _sky(self, directions: np.ndarray) -> np.ndarray:
        """Sky: blue overhead, white at the horizon, with clouds in a horizontal plane."""
        height = np.maximum(directions[:, 2:], 0.03)
        u, v = (directions[:, :2] / height).T
        cloud = self._noise(u, v, 1.1) + 0.5 * self._noise(u, v, 0.4)
        cloud = np.clip(0.35 + 0.6 * cloud, 0.0, 1.0)[:, None] * np.minimum(1.0, 3 * height)
        blue = np.array([0.95, 0.97, 1.0]) + np.sqrt(height) * (np.array([0.30, 0.50, 0.85]) - 1.0)
        return (1 - cloud) * blue + cloud * 0.95

    def _noise(self, u: np.ndarray, v: np.ndarray, cell: float) -> np.ndarray:
        """Value noise in [-1, 1] with features of ``cell`` metres."""
        return map_coordinates(self.lattice, np.stack([u, v]) / cell, order=1, mode="grid-wrap", prefilter=False)


def exposed(daylight: Daylight, camera: Camera, supersampling: int) -> Float[np.ndarray, "height width 3"]:
    """Render the radiance of the pixels, as the mean of ``supersampling``² rays each."""
    origin, directions = rays(camera)
    rotation, focal = camera.viewmat[:3, :3].numpy(), camera.K.diagonal().numpy()[:2]
    steps = (np.arange(supersampling) + 0.5) / supersampling - 0.5
    image = np.zeros(directions.shape)
    for offset in np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2):
        moved = directions + np.float32(offset / focal @ rotation[:2])
        image += daylight.radiance(origin, moved.reshape(-1, 3)).reshape(image.shape)
    return image / supersampling**2


def developed(
    radiance: Float[np.ndarray, "height width 3"], rng: np.random.Generator
) -> UInt8[np.ndarray, "height width 3"]:
    """Turn the radiance into a photograph: gamma 2.2, a little sensor noise."""
    image = 255 * np.clip(radiance, 0.0, 1.0) ** (1 / 2.2)
    return np.clip(image + rng.normal(0.0, 1.5, image.shape), 0, 255).round().astype(np.uint8)


def log_gains(count: int, seed: int = 0) -> Float64[np.ndarray, "V 3"]:
    """Logarithms of gains in linear light, along a walk: smooth, with jumps."""
    rng = np.random.default_rng(seed)

    def walk() -> Float64[np.ndarray, " V"]:
        smooth = gaussian_filter1d(rng.normal(size=count), count / 10, mode="wrap")
        jumps = (np.arange(count)[:, None] >= rng.choice(count, JUMPS)) @ rng.choice([-1.0, 1.0], JUMPS)
        found = smooth / smooth.std() + 0.7 * (jumps - jumps.mean())
        return found / np.abs(found).max()

    stops, red, blue = walk(), walk(), walk()
    balance = np.stack([1 + BALANCE * red, np.ones(count), 1 + BALANCE * blue], axis=1)
    return np.log(2) * STOPS * stops[:, None] + np.log(balance)


def noise_lattice(rng: np.random.Generator) -> Float[np.ndarray, "S S"]:
    """Random numbers for :class:`Daylight`."""
    return rng.uniform(-1.0, 1.0, (256, 256)).astype(np.float32)


def rays(camera: Camera) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, "height width 3"]]:
    """:func:`~shellgs_method.geometry.camera.world_rays` in single precision, as rays are cast."""
    origin, directions = world_rays(camera)
    return origin.astype(np.float32), directions.astype(np.float32)


Noise = Callable[[np.ndarray, np.ndarray, float], np.ndarray]


def _tinted(colour: tuple[float, float, float], shade: np.ndarray) -> np.ndarray:
    return np.clip(np.array(colour) * shade[:, None], 0.0, 1.0)


def _plain(*colour: float) -> Callable[[np.ndarray, Noise], np.ndarray]:
    return lambda points, noise: np.broadcast_to(np.array(colour), points.shape)


def _plaster(points: np.ndarray, noise: Noise) -> np.ndarray:
    """Weakly textured, weathered plaster: grime at the foot, rain streaks, cracks, and graffiti at hand height."""
    along, z = points[:, 0] + points[:, 1], points[:, 2]
    grime = 0.08 * np.exp(-z / 0.35)
    streaks = 0.1 * np.maximum(noise(along, z, 1.3), 0.0) * noise(12 * along, z, 0.7)
    crack = (np.abs(noise(along, z, 0.9)) < 0.012) & (noise(z, along, 1.1) > 0)
    scrawl = (np.abs(noise(along, z, 0.3)) < 0.06) & (np.abs(z - 1.3) < 0.6) & (noise(along, z, 2.1) > 0.2)
    fine = 0.025 * noise(along, z, 1.7) + 0.02 * noise(along, z, 0.07)
    return _tinted((0.74, 0.66, 0.53), 1 - grime + streaks - 0.25 * crack - 0.5 * scrawl + fine)


def _stone(points: np.ndarray, noise: Noise) -> np.ndarray:
    along, z = points[:, 0] + points[:, 1], points[:, 2]
    joint = np.mod(z, 0.55) < 0.012
    return _tinted((0.60, 0.54, 0.45), 1 - 0.12 * joint + 0.09 * noise(along, z, 0.3) + 0.05 * noise(along, z, 0.05))


def _concrete(points: np.ndarray, noise: Noise) -> np.ndarray:
    return _tinted(
        (0.58, 0.57, 0.54),
        1 + 0.05 * noise(points[:, 0], points[:, 2], 0.4) + 0.08 * noise(3 * points[:, 0], points[:, 2], 0.15),
    )


def _wood(points: np.ndarray, noise: Noise) -> np.ndarray:
    x, z = points[:, 0], points[:, 2]
    leaf = np.abs(np.mod(x / BAY, 1.0) - 0.5) * BAY
    groove = (leaf < 0.01) | (np.abs(np.mod(z, 0.85) - 0.42) > 0.37) | (np.abs(leaf - 0.33) > 0.26)
    return _tinted((0.13, 0.17, 0.14), 1 - 0.3 * groove + 0.15 * noise(30 * x, z, 0.8))


def _ground(points: np.ndarray, noise: Noise) -> np.ndarray:
    x, y = points[:, 0], points[:, 1]
    speckle = 1 + 0.10 * noise(x, y, 0.05) + 0.06 * noise(x, y, 0.9)
    joint = (np.mod(x, 0.6) < 0.015) | (np.mod(y, 0.6) < 0.015)
    paving = _tinted((0.42, 0.40, 0.37), speckle - 0.25 * joint)
    kerb = np.where(y > KERB - 0.18, 1.9, 1.0)
    return np.where(y[:, None] > KERB, paving, _tinted((0.21, 0.21, 0.22), speckle * kerb))


def _leaf(points: np.ndarray, noise: Noise) -> np.ndarray:
    return _tinted((0.16, 0.27, 0.08), 1 + 0.5 * noise(points[:, 0] + points[:, 1], points[:, 2], 0.2))


def _flowers(points: np.ndarray, noise: Noise) -> np.ndarray:
    along, z = points[:, 0] + points[:, 1], points[:, 2]
    petals = noise(along, z, 0.05) > 0.25
    colours = np.where(noise(along, z, 0.6)[:, None] > 0, (0.55, 0.08, 0.12), (0.65, 0.55, 0.60))
    return np.where(petals[:, None], colours, _leaf(points, noise))


def _house(points: np.ndarray, noise: Noise) -> np.ndarray:
    x, z = points[:, 0], points[:, 2]
    number = np.floor(x / HOUSE).astype(int)
    palette = np.array(
        [[0.55, 0.24, 0.17], [0.66, 0.60, 0.48], [0.42, 0.46, 0.50], [0.70, 0.52, 0.34], [0.6, 0.6, 0.6]]
    )
    wall = palette[(number * 7) % len(palette)] * (1 + 0.08 * noise(x, z, 0.3))[:, None]
    across, up = np.mod(x, HOUSE / 3) / (HOUSE / 3), np.mod(z, 3.1) / 3.1
    frame = (np.abs(across - 0.5) < 0.29) & (np.abs(up - 0.5) < 0.31)
    pane = (np.abs(across - 0.5) < 0.23) & (np.abs(up - 0.5) < 0.26)
    wall[frame] = 0.75
    wall[pane] = 0.07
    return wall


def _court(points: np.ndarray, noise: Noise) -> np.ndarray:
    along, z = points[:, 0] + points[:, 1], points[:, 2]
    brick = _tinted((0.50, 0.30, 0.22), 1 + 0.12 * noise(along, z, 0.4) + 0.08 * noise(along, z, 0.1))
    across, up = np.mod(along, 2.4) / 2.4, np.mod(z, 3.0) / 3.0
    brick[(np.abs(across - 0.5) < 0.27) & (np.abs(up - 0.5) < 0.33)] = 0.70
    brick[(np.abs(across - 0.5) < 0.22) & (np.abs(up - 0.5) < 0.28)] = 0.08
    return brick


def _car(points: np.ndarray, noise: Noise) -> np.ndarray:
    paint = np.array([[0.45, 0.05, 0.04], [0.08, 0.12, 0.3], [0.75, 0.75, 0.76], [0.05, 0.05, 0.06]])
    colour = paint[np.floor(points[:, 0] / CAR).astype(int) % len(paint)]
    return np.where((np.abs(points[:, 2:] - 1.15) < 0.2), 0.04, colour)


_ALBEDO: dict[Material, Callable[[np.ndarray, Noise], np.ndarray]] = {
    Material.WALL: _plaster,
    Material.COLUMN: _stone,
    Material.SLAB: _concrete,
    Material.DOOR: _wood,
    Material.GLASS: _plain(0.05, 0.06, 0.07),
    Material.FRAME: _plain(0.78, 0.78, 0.76),
    Material.RAILING: _plain(0.05, 0.05, 0.06),
    Material.FLOWERS: _flowers,
    Material.GROUND: _ground,
    Material.POLE: _plain(0.20, 0.24, 0.22),
    Material.TRUNK: _plain(0.20, 0.15, 0.10),
    Material.LEAF: _leaf,
    Material.HOUSE: _house,
    Material.CAR: _car,
    Material.COURT: _court,
}
