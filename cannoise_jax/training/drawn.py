"""Training data of cameras that are drawn: each records its own few scenes, and nothing else is said of it.

Every camera of the prior (`physics.synthetic.prior`) takes patches at one setting, which are targets and
references by turns, and one at another setting, which stands for any image of the camera. What it really is
comes with them, so that what is read off its pixels can be judged.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from jax import Array
from jaxtyping import Float, Int, Key

from cannoise_jax.physics.synthetic.prior import (
    DrawnCamera,
    analogue_drawn,
    another_setting,
    draw_camera,
    stored_drawn,
)
from cannoise_jax.physics.synthetic.scenes import PATCH, Split, draw_scenes, mosaic
from cannoise_jax.recordings.packing import pack

_CHUNK = 32
"""Patches recorded at once."""
_CFAS = ("RGGB", "BGGR", "GRBG", "GBRG")


@dataclass(frozen=True, eq=False)
class DrawnCameras:
    """Recordings of n cameras, r + 1 patches at one setting and then one at another.

    scenes: clean patches; scene, exposure: which of them each patch shows, and how brightly. noise: what is
    recorded beside that, in full precision, so that what is stored as zero is zero. level: (shot, read) of
    the whole variance at the first setting. truth: by name, see `losses.Truth`.
    """

    scenes: Float[np.ndarray, "s 64 64 4"]
    scene: Int[np.ndarray, "n k"]
    exposure: Float[np.ndarray, "n k"]
    noise: Float[np.ndarray, "n k 64 64 4"]
    level: Float[np.ndarray, "n 2"]
    truth: dict[str, Float[np.ndarray, "n"]]

    def __len__(self) -> int:
        return len(self.noise)

    @property
    def references(self) -> int:
        """Patches of the first setting beside the target."""
        return self.noise.shape[1] - 2

    def shown(self, camera, patch) -> np.ndarray:
        """The scene before a camera."""
        return self.scenes[self.scene[camera, patch]] * self.exposure[camera, patch][..., None, None, None]

    def clean(self, camera, patch) -> np.ndarray:
        """What a camera's patch would be without noise. A camera that denoises does it to the scene as well:
        detail that is lost is no noise."""
        scene = self.shown(camera, patch)
        weight = np.broadcast_to(self.truth["blend"][camera], scene.shape[:-3])[..., None, None, None]
        return np.where(weight > 0, (1 - weight) * scene + weight * _neighbour_mean(scene), scene)

    def noisy(self, camera, patch) -> np.ndarray:
        """A patch as recorded."""
        return self.shown(camera, patch) + self.noise[camera, patch]


def drawn_cameras(
    key: Key[Array, ""],
    split: Split,
    cameras: int,
    references: int,
    scenes: int,
    tell: Callable[[int, int], None] = lambda done, total: None,
) -> DrawnCameras:
    """Recordings of `cameras` cameras, on patches of `scenes` scenes of a split. The same key gives the same
    bits. tell: how far it is, patches done and in all."""
    scene_key, camera_key, place_key, record_key = jax.random.split(key, 4)
    pool = _scene_patches(scene_key, split, scenes)
    rng = np.random.default_rng(np.asarray(jax.random.key_data(place_key)).tolist())
    shape = (cameras, references + 2)
    scene = rng.integers(len(pool), size=shape)
    exposure = np.exp(rng.uniform(np.log(0.3), np.log(1.3), shape)).astype(np.float32)
    first, other = _draw(jax.vmap(lambda n: jax.random.fold_in(camera_key, n))(np.arange(cameras)))
    # Every patch with its camera: the last one of each is of the other setting.
    setting = [np.concatenate([np.repeat(x[:, None], references + 1, 1), y[:, None]], 1)
               for x, y in zip(_numbers(first), _numbers(other), strict=True)]  # fmt: skip
    flat = [values.reshape(-1, *values.shape[2:]) for values in setting]
    places, shown = scene.ravel(), exposure.ravel()
    noise = np.empty((cameras * (references + 2), PATCH, PATCH, 4), np.float32)
    lines = np.empty((len(noise), 2), np.float32)
    for start in range(0, len(noise), _CHUNK):
        here = np.minimum(np.arange(start, start + _CHUNK), len(noise) - 1)
        clean = pool[places[here]] * shown[here][:, None, None, None]
        made, line = _record(record_key, here, [values[here] for values in flat], clean)
        noise[here], lines[here] = np.asarray(made), np.asarray(line)
        if start:  # the first holds the compilation
            tell(min(start + _CHUNK, len(noise)), len(noise))
    level = lines.reshape(cameras, references + 2, 2)[:, 0]
    # Shares of the read variance as it is recorded, rounding and all.
    share = np.asarray(first.read) / np.maximum(level[:, 1], 1e-12)
    lined = {n: share * np.square(np.asarray(getattr(first, n))) for n in ("row", "slow_row", "column")}
    return DrawnCameras(
        pool,
        scene,
        exposure,
        noise.reshape(*shape, PATCH, PATCH, 4),
        level,
        {"tail": np.asarray(first.tail), **lined, "blend": np.asarray(first.blend)},
    )


def _neighbour_mean(planes):
    """Mean of the four neighbours of one colour; edges repeat the last sample, as in the sensor model."""
    height, width = planes.shape[-3:-1]
    padded = np.pad(planes, [*[(0, 0)] * (planes.ndim - 3), (1, 1), (1, 1), (0, 0)], mode="edge")
    middle = (slice(1, height + 1), slice(1, width + 1))
    ways = [(slice(i, i + height), middle[1]) for i in (0, 2)]
    ways += [(middle[0], slice(i, i + width)) for i in (0, 2)]
    return sum(padded[..., y, x, :] for y, x in ways) / np.float32(4)


@jax.jit
def _draw(keys):
    """Cameras, and each at another setting."""

    def one(key):
        camera_key, other_key = jax.random.split(key)
        camera = draw_camera(camera_key)
        return camera, another_setting(other_key, camera)

    return jax.vmap(one)(keys)


def _numbers(cameras: DrawnCamera) -> list[np.ndarray]:
    """Their fields as plain arrays, keys as their data."""
    return [*(np.asarray(v) for v in cameras[:-1]), np.asarray(jax.random.key_data(cameras.unit))]


def _record(key, numbers, fields, clean):
    """Noise and line of one patch of each camera; the numbers of the patches keep their draws apart."""
    return _stored(key, numbers, fields, clean, _analogue(key, numbers, fields, clean))


@jax.jit
def _analogue(key, numbers, fields, clean):
    def one(number, fields, clean):
        return analogue_drawn(jax.random.fold_in(key, number), _camera(fields), clean[None])[0]

    return jax.vmap(one)(numbers, fields, clean)


@jax.jit
def _stored(key, numbers, fields, clean, analogue):
    def one(number, fields, clean, analogue):
        own = jax.random.fold_in(key, number)
        noise, line = stored_drawn(own, _camera(fields), clean[None], analogue[None])
        return noise[0], line

    return jax.vmap(one)(numbers, fields, clean, analogue)


def _camera(fields) -> DrawnCamera:
    """The inverse of `_numbers`, of one camera."""
    return DrawnCamera._make([*fields[:-1], jax.random.wrap_key_data(fields[-1])])


def _scene_patches(key, split: Split, scenes: int) -> Float[np.ndarray, "n 64 64 4"]:
    """Four patches of every scene, colours in any order, mirrored or not."""
    patches = []
    for s, scene in enumerate(draw_scenes(key, split, scenes, (4 * PATCH, 4 * PATCH))):
        cfa = _CFAS[s % len(_CFAS)]
        packed = np.asarray(pack(mosaic(scene.image, cfa), cfa))
        patches += [packed[y : y + PATCH, x : x + PATCH] for y in (0, PATCH) for x in (0, PATCH)]
    return np.stack(patches)


class DrawnBatches:
    """Endless batches of drawn cameras, each in its turn; all of batch n depends on (seed, n) alone.

    As `recordings.pipeline`, and: `anchor` [b, r, h, w, 4] of the target's setting, of which `shown` are
    different, a divisor of r; `truth`. size: side of the target, a random window, mirrored on either axis.
    part: only these rows of every batch, one of `parts` equal runs of them.
    """

    def __init__(
        self, cameras: DrawnCameras, batch_size: int, seed: int, size: int, part: int = 0, parts: int = 1
    ):
        self.cameras, self.batch_size, self.seed, self.size = cameras, batch_size, seed, size
        rows = batch_size // parts
        self.rows = slice(part * rows, (part + 1) * rows)
        self.position = 0

    def __iter__(self) -> DrawnBatches:
        return self

    def get_state(self) -> dict[str, Any]:
        """Where it stands."""
        return {"position": self.position}

    def set_state(self, state: dict[str, Any]) -> None:
        """Goes on from there."""
        self.position = int(state["position"])

    def __next__(self) -> dict[str, Any]:
        source, start = self.cameras, self.position * self.batch_size
        rng = np.random.default_rng([self.seed, self.position])
        self.position += 1
        turns = [divmod(start + i, len(source)) for i in range(self.batch_size)]
        chosen = np.array([self._order(turn)[place] for turn, place in turns])
        count = source.references
        patches = np.array([rng.permutation(count + 1) for _ in chosen])
        more = rng.choice(_divisors(count)[1:] or [1], len(chosen))
        shown = np.where(rng.random(len(chosen)) < 0.5, 1, more)
        # Those shown, over and over: each as often as the others.
        anchors = np.take_along_axis(patches[:, 1:], np.arange(count) % shown[:, None], 1)
        windows = [self._window(rng) for _ in chosen]
        # Everything is drawn for the whole batch, whichever rows of it are wanted.
        chosen, patches, shown, anchors = (v[self.rows] for v in (chosen, patches, shown, anchors))
        target = patches[:, 0]
        clean, noisy = (
            np.stack([_cut(image, *w) for image, w in zip(whole, windows[self.rows], strict=True)])
            for whole in (source.clean(chosen, target), source.noisy(chosen, target))
        )
        other = np.full(len(chosen), count + 1)
        shot, read = (np.repeat(source.level[chosen, i][:, None], 4, 1) for i in (0, 1))
        truth = {name: values[chosen] for name, values in source.truth.items()}
        return {
            "clean": clean,
            "noisy": noisy,
            "anchor": source.noisy(chosen[:, None], anchors),
            "positive": source.noisy(chosen, other),
            "shown": shown.astype(np.float32),
            "shot": shot,
            "read": read,
            "camera": chosen.astype(np.int32),
            "truth": {"shot": shot, "read": read, **truth},
        }

    def _order(self, turn: int) -> np.ndarray:
        return np.random.default_rng([self.seed, 1, turn]).permutation(len(self.cameras))

    def _window(self, rng) -> tuple[tuple[slice, slice], tuple[int, ...]]:
        y, x = rng.integers(PATCH - self.size + 1, size=2)
        # Mirrored, colours in a row or column change places, as in a camera of another order.
        flips = tuple(axis for axis in (0, 1) if rng.random() < 0.5)
        return (slice(y, y + self.size), slice(x, x + self.size)), flips


def _divisors(number: int) -> list[int]:
    """Of a whole number, itself among them."""
    return [k for k in range(1, number + 1) if number % k == 0]


def _cut(image: np.ndarray, window: tuple[slice, slice], flips: tuple[int, ...]) -> np.ndarray:
    return np.flip(image[window], flips)
